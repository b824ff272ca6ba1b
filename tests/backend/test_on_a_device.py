"""Run what stands on a CUDA device: nothing mixes devices, results are the CPU's, the host waits where it is said to.

On a true device where there is one, else on what stands in for it (stand_in.py).
"""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from constants import changed
from paper_settings import MappingConfig, TrackingConfig
from sigmasplat import cli
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import BackendError
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_pose_adam
from sigmasplat.fit.target import Keyframe
from sigmasplat.plugins.checks import installation
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.plugins.viewer.layers import ShownMap, render_layer
from sigmasplat.plugins.viewer.snapshot import Snapshot
from sigmasplat.plugins.viewer.snapshot_sources import LiveView
from sigmasplat.render import FieldRenderer, render, self_test
from sigmasplat.render.cpu import CpuView
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from splat_fields import OPTIONS, Gradients, exact_view, params_of, there_and_back
from splat_fits import target_of
from splat_scenes import assert_same_vector, scene
from stand_in import StandIn

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

MAPPING = MappingConfig(weight_alignment=0.3, weight_moment=0.2, weight_isotropy_ratio=0.1)
ROOM = SyntheticRoom(frames=200, width=48, height=36)


def test_the_view_agrees(device: torch.device) -> None:
    s = scene("random", 60)
    params, T = params_of(s), s.T_camera_world.numpy()
    maps, rows, twist = there_and_back(CudaView(s.camera, OPTIONS), params.to(device), T)
    want_maps, want_rows, want_twist = there_and_back(exact_view(s.camera, True), params.double(), T)
    assert maps.device.type == rows.device.type == "cuda"
    assert_same_vector(maps.cpu(), want_maps, 2e-5, "maps")
    assert_same_vector(rows.cpu(), want_rows, 1e-3, "rows")
    assert_same_vector(twist.cpu(), want_twist, what="twist")


def test_render_and_its_gradient_lie_on_the_device(device: torch.device) -> None:
    s = scene("random", 60)
    field, T = GaussianField(params_of(s)), s.T_camera_world.float()
    found = []
    for where, backend in ((device, "auto"), (torch.device("cpu"), "cpu")):
        there = field.copy_to(where)
        there.params.requires_grad_()
        pose = T.to(where, copy=True).requires_grad_()
        seen = render(there, s.camera, pose, s.ref_depth.float().to(where), backend=backend)
        assert seen.uncertainty is not None
        (seen.color.square().sum() + seen.uncertainty.sum() + seen.median_depth.sum()).backward()
        assert there.params.grad is not None and pose.grad is not None
        assert {x.device.type for x in (*vars(seen).values(), pose.grad) if x is not None} == {where.type}
        found.append((seen.color, seen.variance, seen.uncertainty, there.params.grad, pose.grad))
    for name, got, want in zip(("color", "V", "U", "on params", "on pose"), *found, strict=True):
        assert_same_vector(got.detach().cpu(), want.detach(), 2e-3, name)


@pytest.mark.parametrize("pose_there", [False, True])
@pytest.mark.parametrize("field_there", [False, True])
def test_a_render_takes_field_and_pose_from_either_side(
    device: torch.device, field_there: bool, pose_there: bool
) -> None:
    s, host = scene("random", 60), torch.device("cpu")
    params = params_of(s).to(device if field_there else host).requires_grad_()
    T = s.T_camera_world.to(device if pose_there else host, copy=True).requires_grad_()
    seen = render(GaussianField(params), s.camera, T, s.ref_depth.float(), OPTIONS, backend="cuda")
    assert seen.uncertainty is not None
    loss = seen.color.sum() + seen.variance.sum() + seen.uncertainty.sum() + seen.median_depth.sum()
    on_params, on_pose = torch.autograd.grad(loss, [params, T])
    assert (seen.color.device, on_params.device, on_pose.device) == (device, params.device, T.device)
    assert torch.isfinite(on_params).all() and torch.isfinite(on_pose).all()


def test_a_renderer_brings_a_field_once(stand_in: StandIn) -> None:
    s = scene("random", 60)
    one, other = GaussianField(params_of(s)), GaussianField(params_of(s))
    other.get_or_create("harmonics").params.fill_(0.01)
    show, T = FieldRenderer(OPTIONS, "cuda"), s.T_camera_world.numpy()
    seen = [show(field, s.camera, T) for field in (one, other) * 3]
    sent = [copy.numbers for copy in stand_in.copies if copy.to_device and copy.numbers > 16]
    assert sent == [60 * 17, 60 * 45, 60 * 17] and torch.equal(seen[0].color.cpu(), seen[4].color.cpu())
    want = render(other, s.camera, T, backend="cpu")
    torch.testing.assert_close(seen[1].color.cpu(), want.color, rtol=1e-4, atol=1e-4)


def test_a_field_in_other_memory_than_the_view_is_refused(device: torch.device) -> None:
    s = scene("random", 60)
    field, view = GaussianField(params_of(s)), CudaView(s.camera, OPTIONS)
    with pytest.raises(BackendError, match="the view's device"):
        fit_field(field, view, [], MAPPING)
    assert torch.equal(field.params, params_of(s))


@pytest.mark.parametrize("images", [1, 2])
@pytest.mark.parametrize("degree", [0, 1])
def test_a_field_is_fitted(device: torch.device, images: int, degree: int) -> None:
    if images > 1 and degree:
        pytest.skip("view-dependent colour is fitted to one keyframe a step")
    s, found = scene("random", 60), []
    start = params_of(s)
    for view in (CudaView(s.camera, OPTIONS), CpuView(s.camera, OPTIONS)):
        field = GaussianField(params_of(s).to(view.sums.device))
        target = target_of(s.camera, tuple(view.alpha.shape))
        pose = se3.inverse(s.T_camera_world.double().numpy())
        keyframes = [Keyframe(k, target, pose @ se3.exp(0.01 * k * np.ones(6))) for k in range(images)]
        stats = Gradients()
        fit = fit_field(field, view, [keyframes] * 3, MAPPING, degree=degree, stats=stats)
        assert {x.device.type for x in (*(given for _, given in stats.given), *field._tensors)} == {
            view.sums.device.type
        }
        found.append((field.params.cpu() - start, fit.losses, keyframes[-1].T_world_camera))
    assert_same_vector(found[0][0], found[1][0], 2e-2, "what Adam moved")
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-4)
    np.testing.assert_allclose(found[0][2], found[1][2], atol=1e-5)


def test_a_pose_is_found(device: torch.device) -> None:
    s, found = scene("random", 60), []
    T = s.T_camera_world.double().numpy()
    for view in (CudaView(s.camera, OPTIONS), CpuView(s.camera, OPTIONS)):
        params, target = params_of(s).to(view.sums.device), target_of(s.camera, tuple(view.alpha.shape))
        config = TrackingConfig(exposure=True, outlier_factor=10.0, alpha_above=0.1)
        found.append(fit_pose_adam(params, view, target, T, config, 5))
    np.testing.assert_allclose(found[0].T_camera_world, found[1].T_camera_world, atol=1e-5)
    np.testing.assert_allclose(found[0].loss, found[1].loss, rtol=1e-4)


def test_doctor_finds_it_healthy(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    if not torch.version.cuda:  # the emulator is slow
        monkeypatch.setattr(self_test, "SPLATS", 100)
    found = {each.name: each for each in installation.check_cuda()}
    assert found["self-test"].ok, found["self-test"].value
    assert "ms for an image" in found["speed"].value and found["backend auto"].value.startswith("computing on cuda:0")


def waits_of(stand_in: StandIn, do: Any) -> list[tuple[str, str]]:
    """Return what makes the host wait in one round more."""
    counts = []
    for rounds in (2, 3):
        stand_in.forget()
        do(rounds)
        counts.append(Counter(stand_in.waits))
    return sorted((counts[1] - counts[0]).elements())


@pytest.mark.parametrize(("images", "degree"), [(1, 0), (3, 0), (1, 3)])
def test_a_mapping_iteration_waits_once(stand_in: StandIn, images: int, degree: int) -> None:
    s = scene("random", 60)
    view, field = CudaView(s.camera, OPTIONS), GaussianField(params_of(s).to("cuda"))
    target, pose = target_of(s.camera, tuple(view.alpha.shape)), se3.inverse(s.T_camera_world.double().numpy())
    keyframes = [Keyframe(k, target, pose) for k in range(images)]
    waits = waits_of(stand_in, lambda n: fit_field(field, view, [keyframes] * n, MAPPING, degree=degree))
    assert [reason for _, reason in waits] == ["fetching"], "twists and losses of all images, together"


QUICK = {
    "input.width": "48", "mapping.first_iterations": "5", "mapping.iterations": "2", "mapping.every": "2",
    "seeding.first_uniform": "200", "seeding.first_gradient": "200", "submaps.frames": "3", "loops.min_interval": "1",
    "loops.min_similarity": "0.0", "registration.iterations": "2",
    "final.iterations": "3",
}  # fmt: skip
RUNS = {
    "sigma": {},
    # Adam's first steps follow the sign of the gradient: after four, rounding decides about centimetres.
    # A frame in doubt is fitted again with twice the steps. From there on a device records a CUDA graph, but the
    # stand-in for a device cannot.
    "sigma by descent": {
        "tracking.method": "adam", "tracking.iterations": "12", "loops.close": "no",
    },
    "cgslam-fast": {"submaps.frames": "0"},
    "cgslam-loops-fast": {
        "mapping.adjustment": "window", "mapping.window": "2", "primitives.densify": "split+clone",
    },
    "varsplat-fast": {"final.sh_degree": "1", "seeding.shape": "neighbours"},
    "varsplat-fast from a mesh": {"final.seed_from": "mesh"},
}  # fmt: skip
FRAMES = 5


def settings(run: str, backend: str, **changes: str) -> Config:
    named = {name.replace("__", "."): value for name, value in changes.items()}
    config = override(preset(run.split()[0]), QUICK | {"backend": backend} | RUNS[run] | named)
    return dataclasses.replace(
        config,
        tracking=changed(config.tracking, cuda_graphs=False),
        primitives=changed(config.primitives, split_gradient=min(config.primitives.split_gradient, 1e-6)),
        final=changed(config.final, sh_every=2),
    )


def followed(config: Config) -> Slam:
    slam = Slam(config)
    for i in range(FRAMES):
        slam.step(ROOM.frame(i))
    slam.finish()
    return slam


@pytest.mark.parametrize(
    "run",
    [run if run == "sigma" else pytest.param(run, marks=pytest.mark.slow) for run in RUNS if run != "cgslam-fast"],
)
def test_slam_runs(device: torch.device, run: str) -> None:
    ours, theirs = (followed(settings(run, backend)) for backend in ("cuda", "cpu"))
    paths = [slam.trajectory().T_world_camera for slam in (ours, theirs)]
    np.testing.assert_allclose(*paths, atol=5e-3)
    assert len(ours.store) == len(theirs.store) > 1 and len(ours.field) > 100
    assert [loop.accepted for loop in ours.loops] == [loop.accepted for loop in theirs.loops]
    assert ours.mapper.field.params.device.type == "cuda"
    at_rest = [ours.field, *(ours.store.load(index).field for index in range(len(ours.store)))]
    assert {x.device.type for field in at_rest for x in (*field._tensors, field.ids)} == {"cpu"}


def test_a_field_does_not_travel(stand_in: StandIn) -> None:
    """Of all that is sent or fetched while a submap grows, nothing but its first seeds is the size of its field."""
    slam, large = Slam(settings("cgslam-fast", "cuda", seeding__first_uniform="2000")), list[list[str]]()
    for i in range(FRAMES):
        stand_in.forget()
        slam.step(ROOM.frame(i))
        size = 2 * len(slam.mapper.field)
        large.append([copy.by for copy in stand_in.copies if copy.numbers > size and copy.by != "target.py"])
    assert len(slam.keyframe_indices) == 3 and len(slam.field) > 1500 and len(slam.store) == 0
    assert large[0] == ["field.py"] * 3, "what a seed is, and Adam's moments"
    assert not any(large[1:])


def test_what_is_written_is_read_as_from_the_host(device: torch.device, tmp_path: Path) -> None:
    """A run's checkpoint, its state, and what a viewer sees of it."""
    slam, shown = Slam(settings("cgslam-loops-fast", "cuda")), list[Snapshot]()
    watch = LiveView(slam, shown.append, "a run", budget=200)
    for i in range(FRAMES - 1):
        watch(slam.step(ROOM.frame(i)))
    assert {x.device.type for x in slam.checkpoint().values()} == {"cpu"}
    pieces = [piece.field.params for piece in shown[-1].pieces]
    assert pieces and all(params.device.type == "cpu" and 0 < len(params) <= 200 for params in pieces)
    seen = render_layer(ShownMap(slam.field, None, slam.config.render, "cuda"), ROOM.camera, np.eye(4), "U")
    assert seen.pixels.std() > 0
    write_state(tmp_path / "state", state_of(slam), CLASSES, fixed(slam))
    slam.step(ROOM.frame(FRAMES - 1))
    again = Slam(slam.config, slam.store)
    again.prepare(ROOM.camera.prepared(48, 0))
    del again.store.submaps[len(slam.store) - 1 :]  # type: ignore[attr-defined]
    restore(again, read_state(tmp_path / "state", CLASSES, fixed(again)))
    again.step(ROOM.frame(FRAMES - 1))
    for name, written in slam.checkpoint().items():  # the covariance of a first keyframe is not known: NaN
        torch.testing.assert_close(again.checkpoint()[name], written, rtol=0, atol=0, equal_nan=True)


@pytest.mark.slow
def test_a_run_takes_the_device_and_says_so(
    device: torch.device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = QUICK | {"input.width": "32", "input.limit": "4"}
    words = [word for name, value in settings.items() for word in ("--set", f"{name}={value}")]
    with pytest.raises(SystemExit, match="0"):
        cli.main(["run", "synthetic:frames=200,width=32,height=24", "--out", str(tmp_path / "run"), *words])
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"metrics.json", "map.ply", "checkpoint.safetensors"} <= written
    said = capsys.readouterr()
    assert "computing on cuda:0, whose self-test passed" in said.out + said.err
