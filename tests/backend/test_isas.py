"""Hold every instruction set this processor runs to the reference, and to the same bytes on any number of threads."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from sigmasplat.render import reference
from splat_fields import BIG, OPTIONS, crowd, exact_view, params_of, there_and_back
from splat_scenes import KINDS, assert_same_vector, gradients, probe, render, scene

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from sigmasplat.data.field import GaussianField
from sigmasplat.fit.adam import Rates
from sigmasplat.fit.backends import CPU
from sigmasplat.fit.cpu import CompiledStep
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.native import _core
from sigmasplat.render import cpu
from sigmasplat.render.cpu import CpuView

Outputs = dict[str, Tensor]
THREADS = (1, 2, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_maps_and_gradients_agree_with_the_reference(isa: str, kind: str) -> None:
    s = scene(kind, 60)
    want, got = render(reference, s)[1], render(cpu, s.to(torch.float32))[1]
    for name in ("sums", "moment", "alpha", "dominant_weight", "median_weight"):
        a, b = getattr(got, name), getattr(want, name)
        assert float((a - b).norm()) < 2e-5 * float(b.norm()), f"{isa} {kind} {name}"
    assert torch.equal(got.median_id, want.median_id)
    exact, found = gradients(reference, s), gradients(cpu, s.to(torch.float32))
    for name in exact:
        assert_same_vector(found[name], exact[name], what=f"{isa} {kind} {name}")


@pytest.mark.parametrize("kind", ["needles", "huge", "off_screen"])
def test_views_agree_with_the_reference(isa: str, kind: str) -> None:
    s = scene(kind, 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    got = there_and_back(CpuView(s.camera, OPTIONS), params, T)
    want = there_and_back(exact_view(s.camera, True), params.double(), T)
    assert float((got[0] - want[0]).norm()) < 2e-5 * float(want[0].norm())
    assert_same_vector(got[1], want[1], what=f"{isa} {kind} rows")
    assert_same_vector(got[2], want[2], what=f"{isa} {kind} twist")


def seam() -> Outputs:
    """Run `project` and `blend` and their gradients on a crowd."""
    s = crowd().to(torch.float32)
    x = s.requiring_grad()
    p, b = render(cpu, x)
    probe(b.sums, b.moment, b.alpha).backward()
    found = {name: getattr(x, name).grad for name in ("means", "quats", "scales", "opacities", "features")}
    return found | {"pose": x.T_camera_world.grad} | p._asdict() | b._asdict()


def view() -> Outputs:
    """Run the fused way on a crowd."""
    s = crowd()
    maps, rows, twist = there_and_back(CpuView(s.camera, OPTIONS), params_of(s), s.T_camera_world)
    return {"maps": maps, "rows": rows, "twist": twist}


def images(seed: int) -> tuple[Tensor, Tensor]:
    """Draw planes like a view's, (colour, depth, q) [7, rows, columns], and depths [rows, columns] with holes."""
    rng = np.random.default_rng(seed)
    size = cpu.padded_size(BIG)
    planes = rng.uniform(0, 1, (7, *size))
    planes[4:] = planes[:3] ** 2 + rng.uniform(1e-3, 0.2, (3, *size))
    depth = rng.uniform(0.5, 4.0, size) * (rng.random(size) > 0.2)
    depth[BIG.height :], depth[:, BIG.width :] = 0.0, 0.0
    return torch.as_tensor(planes).float(), torch.as_tensor(depth).float()


def losses() -> Outputs:
    """Run SSIM, the pixel losses of mapping, and tracking's loss and reference."""
    (sums, depth_seen), (target, depth) = images(1), images(2)
    target, size = target[:3], (BIG.width, BIG.height)
    gradient, parts = torch.full_like(sums, torch.nan), np.zeros(7)
    median, moment = depth_seen.roll(3, 0).contiguous(), (0.1 * depth_seen).contiguous()
    alpha = (depth_seen / 4.0).contiguous()
    g_median, g_moment, g_alpha = (torch.full_like(plane, torch.nan) for plane in (median, moment, alpha))
    valid = float((depth > 0).sum())
    weights = [0.8, 1.0, 1e-2, 1e-2, 0.3, 0.2, 0.4]
    _core.mapping_losses(
        sums, median, moment, alpha, target, depth, BIG.height, weights, valid, gradient, g_median, g_moment, g_alpha,
        parts,
    )  # fmt: skip
    cache = torch.zeros(_core.ssim_cache_floats(*size))
    _core.ssim_target(target, depth, *size, cache)
    similarity = _core.ssim(sums[:3], target, cache, *size, depth, -0.2, gradient[:3])
    pull, g_exposure = torch.full_like(sums, torch.nan), np.zeros(2)
    numbers = [0.1, 3.0, 5.0, 4.0, 0.6, 2.0, 3.0]
    loss = _core.tracking_loss(sums, alpha, target, depth, *size, numbers, True, True, 1.1, 0.02, pull, g_exposure)
    maps = [np.zeros((BIG.height, BIG.width), np.float32) for _ in range(4)]
    _core.reference_maps(sums, alpha, depth, *size, numbers, True, *maps)
    crop = (slice(4), slice(BIG.height), slice(BIG.width))
    values = torch.tensor([*parts, similarity, loss, *g_exposure], dtype=torch.float64)
    return {
        "values": values,
        "gradient": gradient[:, : BIG.height, : BIG.width],
        "tracking": pull[crop],
        "reference": torch.as_tensor(np.stack(maps)),
    }


def step() -> Outputs:
    """Take three fused steps on a crowd."""
    s = crowd()
    field, view, rates = GaussianField(params_of(s)), CpuView(s.camera, OPTIONS), np.full(17, 1e-2, np.float32)
    twists = []
    for field.steps in (1, 2, 3):
        view.forward(field.params, s.T_camera_world.numpy())
        view.g_sums[:] = torch.as_tensor(np.random.default_rng(field.steps).normal(size=view.g_sums.shape))
        twist, isotropy = CompiledStep(view).splats(field, Rates(torch.as_tensor(rates)), {"isotropy": 0.7}, 100)
        twists.append(torch.tensor([*twist, isotropy]))
        twists.append(torch.as_tensor(view.backward_pose(field.params)))
    return {"params": field.params, "moment1": field.moment1, "moment2": field.moment2, "twists": torch.cat(twists)}


def shiny_step() -> Outputs:
    """Take three steps with view-dependent colours on a crowd."""
    s = crowd()
    field, view, rates = GaussianField(params_of(s)), CpuView(s.camera, OPTIONS), Rates(torch.full((17,), 1e-2))
    view_step, target = CPU.view_dependent_step(CPU.mapping_step(view), 3), torch.zeros(view.alpha.shape)
    twists = []
    for field.steps in (1, 2, 3):
        black = Target(s.camera, torch.zeros(3, *target.shape), target, 0)
        view_step.forward(field, s.T_camera_world.numpy(), black, {})
        view.g_sums[:] = torch.as_tensor(np.random.default_rng(field.steps).normal(size=view.g_sums.shape))
        twists.append(torch.as_tensor(view_step.splats(field, rates, {}, 0)[0]))
    h = field.attributes["harmonics"]
    return {"params": field.params, "harmonics": h.params, "moment2": h.moment2, "twists": torch.cat(twists)}


def align() -> Outputs:
    """Take the normal equations of one alignment."""
    (a, near), (b, far) = images(4), images(5)
    crop = (slice(BIG.height), slice(BIG.width))
    shapes = [Pyramid.of(x[0][crop].numpy(), d[crop].numpy() + 1.0, BIG) for x, d in ((a, near), (b, far))]
    row, T, intrinsics = np.zeros(55), np.eye(4), [BIG.fx, BIG.fy, BIG.cx, BIG.cy]
    T[:3, 3] = [0.02, -0.01, 0.03]
    level = _core.Level(
        shapes[0].gray[0], shapes[0].depth[0], b[1][crop].numpy().copy(), b[2][crop].numpy().copy(), shapes[1].gray[0],
        shapes[1].depth[0], intrinsics, [0.5, 0.5, 0.02, 0.3, 4.0, 1.0],
    )  # fmt: skip
    _core.align_steps(level, T, 1, row)
    assert row[27:32].min() > 100, "the test needs residuals of both kinds"
    return {"normal": torch.as_tensor(row)}


@pytest.mark.parametrize("work", [seam, view, losses, step, shiny_step, align], ids=lambda work: work.__name__)
def test_any_number_of_threads_gives_the_same_bytes(
    isa: str, work: Callable[[], Outputs], set_threads: Callable[[int], None]
) -> None:
    found = []
    for threads in THREADS:
        set_threads(threads)
        assert _core.threads() == threads
        found.append(work())
    for other in found[1:]:
        for name, value in found[0].items():
            assert torch.isfinite(value).all() and torch.count_nonzero(value) > 0, name
            assert torch.equal(value, other[name]), f"{isa} {work.__name__} {name}"
