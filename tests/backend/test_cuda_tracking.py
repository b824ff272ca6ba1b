"""Tracking without the host, emulated: its loss held to the definition, medians exact, descent the Python loop's."""

import dataclasses
import itertools
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from constants import changed
from emulated_cuda import Emulator
from paper_settings import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.errors import BackendError
from sigmasplat.fit.descent import Descent, descend
from sigmasplat.fit.pose import fit_pose_adam
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import tracking_gradient
from sigmasplat.plugins.cuda import descent as cuda_descent
from sigmasplat.plugins.cuda.descent import CudaDescent, CudaTrackingLoss, descend_on_device
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render.cpu import CpuView
from splat_fields import OPTIONS
from splat_fits import Watch
from splat_scenes import assert_same_vector
from splat_wall import CAMERA, TRUTH, Array, lower_median, seen_from, wall
from test_tracking_options import OFF, PAPER, damaged

CPU = torch.device("cpu")
EXPOSURE = torch.tensor([0.12, -0.03])
CHOICES = list(itertools.product(["image", "kept"], [0.0, 2.5], [False, True]))
STEPS = TrackingConfig(lr_rotation=4e-4, lr_translation=1e-3, tau=5.0)
WAYS = {
    "ours": STEPS,
    "exposed": changed(STEPS, exposure=True, lr_exposure=4e-3),
    "amsgrad": changed(STEPS, amsgrad=True, exposure=True),
    "paper": PAPER,
    "paper, exposed": dataclasses.replace(PAPER, exposure=True, uncertainty=True, tau=2.0),
}


pytestmark = pytest.mark.usefixtures("on_the_cpu")


def view_of(variance: bool = True, camera: Camera = CAMERA) -> CudaView:
    return CudaView(camera, OPTIONS, variance, CPU)


@cache
def shown(rows: int = CAMERA.height, columns: int = CAMERA.width) -> Target:
    """Make the damaged target once for views of a size; nobody may write to it."""
    return damaged(view_of() if rows == CAMERA.height else CpuView(CAMERA, OPTIONS))


def launched(view: CudaView, target: Target, config: TrackingConfig, exposure: Tensor = EXPOSURE) -> CudaTrackingLoss:
    """Evaluate the kernels on the view's planes; `found` is the loss and its gradient by the exposure [3]."""
    view.g_sums.fill_(torch.nan)  # whatever was there must go
    loss = CudaTrackingLoss(view, target, config, torch.stack([exposure[0].exp(), exposure[1]]))
    loss.found = loss.launch().sum(0)  # type: ignore[attr-defined]
    return loss


# ---- the loss


def assert_as_defined(view: CudaView, target: Target, config: TrackingConfig) -> None:
    """Hold loss, planes and the exposure's gradient to torch's on the very same planes."""
    got = launched(view, target, config).found  # type: ignore[attr-defined]
    planes = view.g_sums.clone()
    view.g_sums.fill_(torch.nan)
    want, want_exposure = tracking_gradient(view, target, config, EXPOSURE)
    assert float(got[0]) == pytest.approx(want, rel=1e-5) and want > 0
    assert_same_vector(planes, view.g_sums, 1e-5, "planes")
    assert_same_vector(got[1:], want_exposure, 1e-5, "exposure")


@pytest.mark.parametrize(("average", "factor_color", "uncertainty"), CHOICES)
def test_the_loss_is_as_defined(average: Any, factor_color: float, uncertainty: bool) -> None:
    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    for alpha_above, factor, power in ((0.0, 5.0, 3.0), (0.9, 0.0, 0.0), (0.97, 3.0, 2.0)):
        config = TrackingConfig(
            average=average, outlier_factor_color=factor_color, uncertainty=uncertainty, tau=2.0, weight_color=0.3,
            alpha_above=alpha_above, outlier_factor=factor, alpha_power=power,
        )  # fmt: skip
        assert_as_defined(view, shown(), config)


def test_without_variance_nothing_is_weighed() -> None:
    view = view_of(variance=False)
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    assert_as_defined(view, shown(), dataclasses.replace(PAPER, uncertainty=True))


def test_weights_and_masks_matter_here() -> None:
    """What the test before compares is not the same whatever the settings."""
    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    base = dataclasses.replace(PAPER, alpha_above=0.9, outlier_factor=5.0, tau=2.0)
    changes: list[dict[str, Any]] = [
        {}, {"average": "image"}, {"outlier_factor_color": 2.5}, {"uncertainty": True}, {"alpha_above": 0.0},
        {"outlier_factor": 2.0}, {"alpha_power": 2.0}, {"uncertainty": True, "weight_max": 1.01},
    ]  # fmt: skip
    losses = [
        float(launched(view, shown(), changed(base, **c)).found[0])  # type: ignore[attr-defined]
        for c in changes
    ]
    assert len({round(loss, 6) for loss in losses}) == len(changes)


@pytest.mark.parametrize("average", ["image", "kept"])
@pytest.mark.parametrize("uncertainty", [False, True])
def test_nothing_kept_is_no_loss_and_no_gradient(average: Any, uncertainty: bool) -> None:
    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    target = damaged(view)
    target.depth.zero_()
    config = changed(PAPER, average=average, uncertainty=uncertainty)
    found = launched(view, target, config).found  # type: ignore[attr-defined]
    assert found.tolist() == [0.0, 0.0, 0.0] and torch.count_nonzero(view.g_sums) == 0  # NaN is not zero


def test_a_render_of_nothing_numeric_counts_nowhere() -> None:
    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    view.sums[:, 3, 4:9] = torch.nan
    config = dataclasses.replace(PAPER, alpha_above=0.0, uncertainty=True)
    found = launched(view, shown(), config).found  # type: ignore[attr-defined]
    assert torch.isfinite(found).all() and torch.isfinite(view.g_sums).all() and found[0] > 0


@pytest.mark.parametrize("order", [1, 2, 3], ids=["warp by warp", "backwards", "shuffled"])
def test_the_order_of_threads_between_barriers_means_nothing(on_the_cpu: Emulator, order: int) -> None:
    def found() -> list[Tensor]:
        loss = launched(view, shown(), dataclasses.replace(PAPER, uncertainty=True))
        return [loss.found, view.g_sums.clone()]  # type: ignore[attr-defined]

    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    want = found()
    on_the_cpu.order = order
    assert all(torch.equal(a, b) for a, b in zip(found(), want, strict=True))


# ---- medians

RNG = np.random.default_rng(0)
ERRORS = {
    "one": [0.25],
    "two": [3.0, 0.5],
    "even": RNG.exponential(size=100),
    "odd": RNG.exponential(size=101),
    "nearly equal": 1.0 + np.arange(64) * 2.0**-23,
    "ties": RNG.integers(0, 3, 77) / 4,
    "zeros": np.zeros(9),
    "many, of any size": np.exp(RNG.uniform(-60, 60, 3001)),
    "smallest": np.arange(1, 30) * 1.4e-45,
}


@pytest.mark.parametrize("name", ERRORS)
def test_medians_are_exact(name: str) -> None:
    """Of depth's errors, of colour's, and of V + ε per channel, each of another order of the same numbers."""
    values = np.asarray(ERRORS[name], np.float32)
    camera = Camera(61, 53, 50.0, 50.0, 30.0, 26.0)
    view, place = view_of(True, camera), np.random.default_rng(1).permutation(61 * 53)[: len(values)]
    depth, errors = np.zeros((53, 61), np.float32), RNG.permutation(values)
    depth.flat[place] = 1.4e-45  # a reading, the smallest there is
    target = Target.of(Frame(0, 0.0, np.zeros((53, 61, 3), np.float32), depth, camera), (53, 61))
    view.sums.flatten(1)[3, place] = torch.from_numpy(errors)
    both = torch.from_numpy(RNG.permutation(values))
    view.sums.flatten(1)[0, place] = both  # red is off by so much,
    view.sums.flatten(1)[5, place] = both  # and so large is the variance of green
    view.alpha.fill_(1.0)
    factor = 1e6  # more than any here is of its median, but of many of them
    config = TrackingConfig(outlier_factor=factor, outlier_factor_color=factor, weight_color=0.5)
    loss = launched(view, target, config, torch.zeros(2))
    known = loss.selection[1][:, 2]
    assert isinstance(known, Tensor) and (known[:, 1] >= 0).all()
    of_depth, of_color, *of_variance = (float(bits.view(torch.float32)) for bits in known[:, 0])
    assert of_depth == float(lower_median((view.sums[3] - target.depth).abs()[target.depth > 0]))
    assert of_color == float(lower_median(torch.from_numpy(values)))
    kept = torch.from_numpy(values)[torch.from_numpy(values) <= torch.tensor(factor) * of_color]
    for channel, found in enumerate(of_variance):
        V = kept if channel == 1 else torch.zeros_like(kept)
        assert found == float(lower_median(V + 1e-6))


def test_a_median_of_variances_is_exact() -> None:
    view = view_of()
    view.forward(wall(), se3.exp(OFF) @ TRUTH)
    target, config = shown(), TrackingConfig(outlier_factor=0.0)
    color = view.sums[:3].clone()
    color.mul_(16).round_().div_(16)  # so that squares are exact, fused or not
    view.sums[:3] = color
    known = launched(view, target, config).selection[1]
    assert isinstance(known, Tensor)
    read = target.depth_image > 0
    for c in range(3):
        V = (view.sums[4 + c] - color[c] ** 2).clamp(min=0) + 1e-6
        assert float(known[2 + c, 2, 0].view(torch.float32)) == float(lower_median(V[read]))


# ---- the descent


@pytest.fixture
def looking_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_descent, "LOOK", 2)
    monkeypatch.setattr(cuda_descent, "GRAPH_FROM", 3)


def both_ways(
    config: TrackingConfig, iterations: int, variance: bool = True, start: Array = OFF
) -> tuple[Descent, Descent]:
    """Descend on the device and by the Python loop over the same kernels."""
    found = []
    for way in (descend_on_device, descend):
        found.append(way(wall(), view_of(variance), shown(), se3.exp(start) @ TRUTH, config, iterations))  # type: ignore[operator]
    return found[0], found[1]


def assert_same_descent(got: Descent, want: Descent, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(got.T_camera_world, want.T_camera_world, atol=atol)
    np.testing.assert_allclose(got.exposure, want.exposure, atol=atol)
    np.testing.assert_allclose([got.first_loss, got.loss], [want.first_loss, want.loss], rtol=1e-5)
    assert got.steps == want.steps


@pytest.mark.parametrize(("name", "variance"), [*((name, True) for name in WAYS), ("ours", False)])
def test_a_descent_is_the_loops(name: str, variance: bool) -> None:
    got, want = both_ways(WAYS[name], 8, variance)
    assert_same_descent(got, want)
    assert got.steps == 8 and got.loss < 0.95 * got.first_loss
    assert (got.exposure != (0.0, 0.0)) == WAYS[name].exposure


@pytest.mark.parametrize("name", ["exposed", "paper"])
def test_a_pose_is_found_as_on_the_cpu(name: str) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    fits = []
    for view in (view_of(), CpuView(CAMERA, OPTIONS)):
        fits.append(fit_pose_adam(wall(), view, shown(*view.alpha.shape), se3.exp(OFF) @ TRUTH, WAYS[name], 12))
    np.testing.assert_allclose(fits[0].T_camera_world, fits[1].T_camera_world, atol=1e-5)
    np.testing.assert_allclose(fits[0].exposure, fits[1].exposure, atol=1e-4)
    assert fits[0].loss == pytest.approx(fits[1].loss, rel=1e-4) and fits[0].iterations == fits[1].iterations == 12
    assert (fits[0].agreement, fits[0].overlap) == pytest.approx((fits[1].agreement, fits[1].overlap), abs=5e-3)


def test_where_the_camera_looks_back_an_axis_is_as_good(on_the_cpu: Emulator) -> None:
    """|ω| near π, and |ω| = 0 exactly, where sinθ/θ is a series."""
    turn = np.eye(4)
    turn[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    turned = wall().clone()
    turned[:, [0, 2]] *= -1.0
    for params, T in ((turned, TRUTH @ turn), (wall(), np.eye(4))):
        found = []
        for way in (descend_on_device, descend):
            found.append(way(params, view_of(), shown(), T, PAPER, 6))  # type: ignore[operator]
        assert_same_descent(*found)


@pytest.mark.usefixtures("looking_often")
@pytest.mark.parametrize("name", ["ours", "paper"])
def test_it_stops_where_the_loop_stops(name: str) -> None:
    crawling = dataclasses.replace(WAYS[name], lr_rotation=1e-9, lr_translation=1e-9)
    flat = changed(crawling, plateau_stop=1e-3, plateau_window=5)
    got, want = both_ways(flat, 30)
    assert got.steps == want.steps == 6
    fast = dataclasses.replace(WAYS[name], lr_rotation=1e-3, lr_translation=3e-3)
    got, want = both_ways(changed(fast, plateau_stop=1e-2, plateau_window=2), 30)
    assert_same_descent(got, want, 1e-5)
    assert 3 < got.steps < 30


def test_the_best_iterate_wins() -> None:
    got, want = both_ways(dataclasses.replace(STEPS, lr_translation=0.5), 4)
    np.testing.assert_allclose(got.T_camera_world, se3.exp(OFF) @ TRUTH, atol=1e-12)
    assert got.loss == got.first_loss and got.steps == 4
    assert_same_descent(got, want)


def test_an_iterate_that_sees_nothing_does_not_win() -> None:
    far = dataclasses.replace(PAPER, lr_translation=10.0)
    got, want = both_ways(far, 3)
    assert got.loss == got.first_loss > 0.0
    assert_same_descent(got, want)


def test_without_a_reading_the_guess_comes_back() -> None:
    view = view_of()
    blind = seen_from(view, TRUTH)
    blind.depth.zero_()
    fit = fit_pose_adam(wall(), view, dataclasses.replace(blind, valid_pixels=0), TRUTH, STEPS, 3)
    np.testing.assert_allclose(fit.T_camera_world, TRUTH, atol=1e-9)
    assert fit.loss == 0.0 and fit.iterations == 3 and fit.agreement == fit.overlap == 0.0


@pytest.mark.parametrize("n", [0, 1])
def test_hardly_a_splat_or_none(n: int) -> None:
    fit = fit_pose_adam(wall()[:n].clone(), view_of(), shown(), TRUTH, STEPS, 3)
    assert fit.iterations == 3 and np.isfinite(fit.T_camera_world).all()


def test_no_iteration_is_no_step() -> None:
    got, want = both_ways(STEPS, 0)
    assert_same_descent(got, want)
    assert got.steps == 0 and got.first_loss == np.inf


# ---- room for pairs


def descended(iterations: int, room: int | None, config: TrackingConfig = STEPS) -> tuple[Descent, CudaView]:
    view = view_of()
    view.raster.capacity = room
    return descend_on_device(wall(), view, shown(), se3.exp(OFF) @ TRUTH, config, iterations), view


@pytest.mark.usefixtures("looking_often")
@pytest.mark.parametrize("iterations", [1, 7])
def test_too_little_room_changes_no_bit(iterations: int) -> None:
    """From the first iteration on, and from some later one, of which the host hears when it has launched more."""
    nearing = dataclasses.replace(STEPS, lr_translation=2e-2)
    want, _ = descended(iterations, None, nearing)
    for room in (7, pairs_at(se3.exp(OFF) @ TRUTH)):
        got, view = descended(iterations, room, nearing)
        np.testing.assert_array_equal(got.T_camera_world, want.T_camera_world)
        assert got[1:] == want[1:] and got.steps == iterations
        grown = (view.raster.capacity or 0) > room
        assert grown == (room == 7 or iterations > 1), "some iterations found too little room"


def test_without_room_for_all_the_way_back_reads_no_record() -> None:
    view, pose = view_of(), torch.eye(4)
    view.raster.capacity = 7
    view.follow(wall(), pose)
    view.g_sums.fill_(1.0)
    total, room = view.raster.pairs
    assert int(total) > room == 7
    assert torch.count_nonzero(view.follow_back(wall(), pose)) == 0  # NaN is not zero
    view.raster.expect(int(total))
    view.follow(wall(), pose)
    assert torch.count_nonzero(view.follow_back(wall(), pose)) > 0


def pairs_at(T_camera_world: Array) -> int:
    view = view_of()
    view.forward(wall(), T_camera_world)
    return int(view.raster.pairs[0])


def test_pairs_that_cannot_be_numbered_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sigmasplat.plugins.cuda.raster.MOST_PAIRS", 100)
    with pytest.raises(BackendError, match=r"\d+ pairs of splats and tiles are too many"):
        descended(3, 7)


# ---- the host


def test_no_iteration_makes_the_host_wait() -> None:
    view = view_of()
    view.forward(wall(), TRUTH)
    descent = CudaDescent(wall(), view, shown(), TRUTH, dataclasses.replace(PAPER, uncertainty=True))
    with Watch() as watch:
        descent.iterate()
    assert watch.reads == 0


class Recorded:
    """Stands for a graph: what was launched when it was made, run again."""

    made = 0

    def __init__(self, work: Any, device: torch.device) -> None:
        self.work = work
        Recorded.made += 1

    def __call__(self) -> None:
        self.work()


@pytest.fixture
def graphs(monkeypatch: pytest.MonkeyPatch, looking_often: None) -> type[Recorded]:
    Recorded.made = 0
    monkeypatch.setattr(cuda_descent, "repeatable", Recorded)
    return Recorded


def test_one_graph_is_made_and_run_again(graphs: type[Recorded]) -> None:
    want, _ = descended(7, None, changed(STEPS, cuda_graphs=False))
    assert graphs.made == 0
    got, _ = descended(7, None)
    assert graphs.made == 1 and got[1:] == want[1:]
    np.testing.assert_array_equal(got.T_camera_world, want.T_camera_world)


def test_a_graph_is_made_anew_where_room_was(graphs: type[Recorded]) -> None:
    nearing = dataclasses.replace(STEPS, lr_translation=2e-2)
    want, _ = descended(9, None, nearing)
    got, _ = descended(9, pairs_at(se3.exp(OFF) @ TRUTH), nearing)
    assert graphs.made == 3 and got[1:] == want[1:]


def test_a_few_iterations_are_no_graph(graphs: type[Recorded]) -> None:
    descended(cuda_descent.GRAPH_FROM, None)
    assert graphs.made == 0
