"""Hold alignment on a CUDA device, emulated, to the CPU's kernels and to its definition in float64."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from align_oracle import CAMERA, HUGE, MISSING, Pair, missing, oracle, pair
from emulated_cuda import Emulator
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.readout import Readout, SensorTimes, readouts
from sigmasplat.errors import BackendError
from sigmasplat.fit import align as aligning
from sigmasplat.fit.align import Alignment, align
from sigmasplat.fit.cpu import CPU_IMAGES
from sigmasplat.fit.interface import LevelPlanes
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.plugins.cuda.images import CUDA_IMAGES, MOTIONS
from sigmasplat.plugins.sources import SyntheticRoom
from splat_fits import Watch

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

EMPTY = torch.empty


def rubbish(*size: Any, dtype: torch.dtype = torch.float32, device: Any = None) -> Tensor:
    """Make room as a device might: what nobody writes is not zero."""
    return EMPTY(*size, dtype=dtype, device=device).fill_(torch.nan)


@pytest.fixture(autouse=True)
def on_the_cpu(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> Iterator[Emulator]:
    monkeypatch.setattr(torch, "empty", rubbish)
    with emulator.standing_in():
        emulator.order = 0
        yield emulator
        emulator.order = 0


def room(width: int, height: int) -> SyntheticRoom:
    return SyntheticRoom(frames=200, width=width, height=height, exposure_change=False)


def seen(i: int, width: int = 80, height: int = 60, weighed: bool = False) -> Pyramid:
    frame = room(width, height).frame(i)
    weights = np.random.default_rng(i).random((2, height, width)).astype(np.float32)
    image = Pyramid.of(gray_of(frame.color), frame.depth_m, frame.camera)
    return image.weighed(*weights) if weighed else image


def there(image: Pyramid, device: str = "cpu") -> Pyramid:
    """Lay the finest images out on a device, and halve them there."""
    gray, depth, *weights = (
        None if planes[0] is None else torch.tensor(planes[0], device=device)
        for planes in (image.gray, image.depth, image.weight, image.weight_depth)
    )
    assert gray is not None and depth is not None
    return Pyramid.of(gray, depth, image.cameras[0], levels=len(image.cameras), backend="cuda").weighed(*weights)


@pytest.mark.parametrize("size", [(80, 60), (97, 69), (33, 32)], ids=str)
@pytest.mark.parametrize("weighed", [False, True])
def test_pyramids_are_the_cpus_to_the_bit(size: tuple[int, int], weighed: bool) -> None:
    want = seen(10, *size, weighed)
    depth = np.array(want.depth[0])
    depth[5:20, 7:30:3] = 0.0
    depth[np.random.default_rng(0).random(depth.shape) < 0.3] = 0.0
    want = Pyramid.of(want.gray[0], depth, want.cameras[0]).weighed(want.weight[0], want.weight_depth[0])
    got = there(want)
    assert got.cameras == want.cameras and len(want.cameras) > 1
    for name in ("gray", "depth", "weight", "weight_depth"):
        for ours, theirs in zip(getattr(got, name), getattr(want, name), strict=True):
            assert (ours is None) == (theirs is None) == (not weighed and name.startswith("weight"))
            if ours is not None:
                np.testing.assert_array_equal(ours.numpy(), theirs)
    np.testing.assert_allclose(got.readings.numpy(), want.readings, rtol=1e-6)


def test_one_weight_is_for_both() -> None:
    image = there(seen(10)).weighed(torch.rand(60, 80))
    assert image.weight[0] is not None
    assert all(one is other for one, other in zip(image.weight, image.weight_depth, strict=True))


def level_of(p: Pair, weighed: bool = True, device: str | None = None) -> LevelPlanes:
    """Lay a pair out: arrays, or tensors on a device."""
    planes = (p.gray, p.depth, p.weight if weighed else None, p.weight_depth if weighed else None)
    images = [None if x is None else np.ascontiguousarray(x, np.float32) for x in (*planes, p.live_gray, p.live_depth)]
    if device is not None:
        images = [None if x is None else torch.from_numpy(x).to(device) for x in images]
    c = CAMERA
    options = [p.colors, p.depths, p.huber_gray, p.huber_depth, p.gate, p.gain]
    return LevelPlanes(*images, [c.fx, c.fy, c.cx, c.cy], options)


def as_the_cpu_and_the_residuals(p: Pair, weighed: bool = True) -> aligning.Normal:
    """Return the normal equations of a pair, which are those of the CPU and of the differentiated residuals."""
    (got,) = aligning.normal_equations(CUDA_IMAGES, level_of(p, weighed, "cpu"), [p.T])
    (want,) = aligning.normal_equations(CPU_IMAGES, level_of(p, weighed), [p.T])
    H, b, sums, grays = oracle(p)
    np.testing.assert_array_equal(got.sums[1:], want.sums[1:])
    np.testing.assert_array_equal(got.sums[1:], sums[1:])
    values = (
        (got.H, want.H, H),
        (got.b, want.b, b),
        (got.sums[:1], want.sums[:1], sums[:1]),
        (got.grays, want.grays, grays),
    )
    for ours, theirs, exact in values:
        assert np.linalg.norm(ours - theirs) < 1e-5 * np.linalg.norm(theirs)
        assert np.linalg.norm(ours - exact) < 1e-3 * np.linalg.norm(exact)
    assert np.linalg.norm(got.S - want.S) < 1e-5 * np.linalg.norm(want.S)
    return got


@pytest.mark.parametrize("weighed", [True, False], ids=["weighed", "unweighed"])
@pytest.mark.parametrize("holes", [False, True], ids=["whole", "holes"])
@pytest.mark.parametrize("huber", [(HUGE, HUGE), (0.05, 0.004)], ids=["quadratic", "huber"])
def test_normal_equations_are_the_cpus_and_those_of_the_residuals(huber: Any, holes: bool, weighed: bool) -> None:
    p = dataclasses.replace(pair(*huber, holes), gain=1.2 if weighed else 1.0)
    if not weighed:
        p = dataclasses.replace(p, weight=np.ones_like(p.weight), weight_depth=np.ones_like(p.weight_depth))
    got = as_the_cpu_and_the_residuals(p, weighed)
    assert got.sums[1] > 800 and (not holes or got.sums[1] > got.sums[3] + 20 < got.sums[2])
    assert np.linalg.eigvalsh(got.S).min() > -1e-9 * np.linalg.eigvalsh(got.S).max()


@pytest.mark.parametrize("share", MISSING)
def test_missing_readings_leave_the_normal_equations_those_of_the_cpu_and_of_the_residuals(share: float) -> None:
    as_the_cpu_and_the_residuals(missing(pair(0.05, 0.004), share))


RATE = np.array([0.4, -0.3, 0.2, 0.3, -0.5, 0.4])
TIMES = SensorTimes(0.02, 0.03, -0.025, std_s=(0.001, 0.001, 0.001))
LATE = Readout(RATE, 0.005, TIMES), Readout(-0.7 * RATE[::-1], -0.01, TIMES)


@pytest.mark.parametrize("which", [(1, 1), (1, 0), (0, 1)], ids=["both", "reference", "live"])
@pytest.mark.parametrize("holes", [False, True], ids=["whole", "holes"])
def test_rows_that_are_read_late_give_the_normal_equations_of_the_cpu(holes: bool, which: tuple[int, int]) -> None:
    p = pair(0.05, 0.004, holes)
    late = readouts(*(readout if known else None for readout, known in zip(LATE, which, strict=True)))
    motions = [se3.exp(sign * 0.004 * np.ones(6)) @ p.T for sign in (0.0, 1.0, -1.0)]
    at_once = aligning.normal_equations(CPU_IMAGES, level_of(p), motions, whole=2)
    found = aligning.normal_equations(CUDA_IMAGES, level_of(p, device="cpu")._replace(readouts=late), motions, whole=2)
    expected = aligning.normal_equations(CPU_IMAGES, level_of(p)._replace(readouts=late), motions, whole=2)
    for got, want, without in zip(found, expected, at_once, strict=True):
        np.testing.assert_array_equal(got.sums[1:], want.sums[1:])
        assert (want.sums[1:] > 0).all() and want.sums[4] <= (p.depth > 0).sum()
        for name in ("H", "b", "S"):
            ours, theirs = getattr(got, name), getattr(want, name)
            assert np.linalg.norm(ours - theirs) < 1e-5 * np.linalg.norm(theirs)
        assert got.sums[0] == pytest.approx(want.sums[0], rel=1e-5)
        assert np.linalg.norm(got.b - without.b) > 0.1 * np.linalg.norm(without.b), "the times matter"


def test_fewer_rows_of_a_high_image_are_those_of_the_cpu() -> None:
    v, u = np.indices((250, 40), dtype=np.float32)
    planes = [np.float32(0.5 + 0.3 * np.sin(0.3 * u) * np.cos(0.2 * v)), np.float32(2.0 + 0.1 * np.sin(0.1 * (u + v)))]
    on_cpu = LevelPlanes(*planes, None, None, *planes, [60.0, 60.0, 19.5, 124.5], [0.5, 0.5, 0.02, 0.003, 0.1, 1.0])
    tensors = [torch.from_numpy(plane) for plane in planes]
    on_device = on_cpu._replace(
        reference_gray=tensors[0], reference_depth=tensors[1], live_gray=tensors[0], live_depth=tensors[1]
    )
    motions = [se3.exp(np.full(6, 1e-3)), se3.exp(np.full(6, 2e-3))]
    found = aligning.normal_equations(CUDA_IMAGES, on_device, motions, whole=1)
    expected = aligning.normal_equations(CPU_IMAGES, on_cpu, motions, whole=1)
    for got, want in zip(found, expected, strict=True):
        np.testing.assert_array_equal(got.sums[1:], want.sums[1:])
        assert np.linalg.norm(got.H - want.H) < 1e-5 * np.linalg.norm(want.H)
    assert expected[1].sums[1] < 0.6 * expected[0].sums[1]


def test_several_motions_at_once_are_each_alone() -> None:
    p = pair(0.05, 0.004, True)
    motions = [se3.exp(0.002 * k * np.ones(6)) @ p.T for k in range(MOTIONS)]
    level = level_of(p, device="cpu")
    for T, n in zip(motions, aligning.normal_equations(CUDA_IMAGES, level, motions), strict=True):
        (alone,) = aligning.normal_equations(CUDA_IMAGES, level, [T])
        for name in ("H", "b", "S", "sums"):
            np.testing.assert_array_equal(getattr(n, name), getattr(alone, name))


def test_a_reference_behind_the_camera_contributes_nothing() -> None:
    (n,) = aligning.normal_equations(CUDA_IMAGES, level_of(pair(), device="cpu"), [np.diag([-1.0, 1.0, -1.0, 1.0])])
    assert not n.H.any() and not n.b.any() and not n.S.any() and not n.sums.any()


def test_planes_of_a_level_are_alike() -> None:
    images = [torch.zeros(40, 30) for _ in range(6)]
    for planes in ([*images[:5], torch.zeros(40, 31)], [image.double() for image in images]):
        with pytest.raises(ValueError, match="planes of a level"):
            aligning.normal_equations(CUDA_IMAGES, LevelPlanes(*planes, [1.0] * 4, [1.0] * 5), [np.eye(4)])


def test_images_in_two_places_are_refused_in_one_line() -> None:
    with pytest.raises(BackendError, match="make both for the same view"):
        align(there(seen(10)), seen(12), np.eye(4))


def assert_same(ours: Alignment, theirs: Alignment, atol: float = 1e-6) -> None:
    assert ours.steps == theirs.steps and ours.degenerate == theirs.degenerate
    np.testing.assert_allclose(ours.T_live_reference, theirs.T_live_reference, atol=atol)
    np.testing.assert_allclose(
        [ours.agreement, ours.overlap, ours.cost], [theirs.agreement, theirs.overlap, theirs.cost], rtol=1e-3
    )


@pytest.mark.parametrize(("size", "weighed"), [((80, 60), True), ((81, 59), False)], ids=str)
def test_two_images_are_aligned_as_on_the_cpu(size: tuple[int, int], weighed: bool) -> None:
    reference, live = seen(10, *size, weighed), seen(12, *size)
    guess = se3.exp(np.array([0.003, -0.002, 0.001, 0.002, 0.001, -0.003]))  # no point falls on the middle of a pixel
    theirs = align(reference, live, guess, 8)
    ours = align(there(reference), there(live), guess, 8)
    assert theirs.steps > 4 and np.abs(theirs.T_live_reference - np.eye(4)).max() > 0.02
    assert_same(ours, theirs, 1e-5)
    np.testing.assert_allclose(
        ours.covariance, theirs.covariance, rtol=1e-2, atol=1e-3 * np.abs(theirs.covariance).max()
    )
    assert np.linalg.eigvalsh(ours.covariance).min() > 0


def test_images_whose_rows_are_read_late_are_aligned_as_on_the_cpu() -> None:
    reference, live = seen(10), seen(12)
    guess = se3.exp(np.array([0.003, -0.002, 0.001, 0.002, 0.001, -0.003]))
    theirs = align(reference.read(LATE[0]), live.read(LATE[1]), guess, 8)
    ours = align(there(reference).read(LATE[0]), there(live).read(LATE[1]), guess, 8)
    assert_same(ours, theirs, 1e-5)
    np.testing.assert_allclose(
        ours.covariance, theirs.covariance, rtol=1e-2, atol=1e-3 * np.abs(theirs.covariance).max()
    )
    at_once = align(reference, live, guess, 8)
    assert np.abs(theirs.T_live_reference - at_once.T_live_reference).max() > 1e-3, "the times matter"


@pytest.mark.parametrize("stops", [(0.0, 0.0), (1e-4, 0.0), (0.0, 3e-2)], ids=["never", "update", "plateau"])
@pytest.mark.parametrize("iterations", [0, 1, 5])
def test_steps_end_as_on_the_cpu(iterations: int, stops: tuple[float, float]) -> None:
    reference, live = seen(10), seen(12)
    theirs = align(reference, live, np.eye(4), iterations, 0.3, *stops)
    ours = align(there(reference), there(live), np.eye(4), iterations, 0.3, *stops)
    assert_same(ours, theirs)
    assert stops != (0.0, 0.0) or ours.steps == iterations * len(live.cameras)
    assert ours.depth_m == pytest.approx(theirs.depth_m, rel=1e-6)


def test_a_bare_wall_decides_three_directions() -> None:
    normal = np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    depth = (-2.0 * np.cos(0.4) / (CAMERA.rays() @ normal)).astype(np.float32)
    wall = Pyramid.of(np.full(depth.shape, 0.5, np.float32), depth, CAMERA)
    guess = se3.exp(np.array([0.02, 0.02, -0.01, 0.004, -0.003, 0.0]))
    theirs, ours = align(wall, wall, guess, 8), align(there(wall), there(wall), guess, 8)
    assert ours.degenerate == 3
    assert_same(dataclasses.replace(ours, cost=0.0), dataclasses.replace(theirs, cost=0.0), 1e-5)
    deviations = [np.sqrt(np.linalg.eigvalsh(a.covariance[:3, :3])) for a in (ours, theirs)]
    np.testing.assert_allclose(*deviations, rtol=1e-2)
    assert deviations[0][0] < 0.01 < 0.3 < deviations[0][1]


@pytest.mark.parametrize("blind", ["reference", "both"])
def test_with_nothing_in_common_the_guess_comes_back(blind: str) -> None:
    frame = room(48, 36).frame(10)
    dark = there(Pyramid.of(gray_of(frame.color), np.zeros_like(frame.depth_m), frame.camera))
    guess = se3.exp(np.array([0.01, 0.0, 0.02, 0.0, 0.01, 0.0]))
    found = align(dark, dark if blind == "both" else there(seen(12, 48, 36)), guess, 3)
    np.testing.assert_allclose(found.T_live_reference, guess, atol=1e-12)
    assert found.overlap == 0.0 and found.agreement == 0.0 and found.degenerate == 6
    assert found.steps == len(dark.cameras), "a level without pixels ends at once"
    np.testing.assert_array_equal(found.covariance, np.diag(np.full(6, np.inf)))


@pytest.mark.parametrize("order", [0, 1, 2, 3], ids=["again", "warp by warp", "backwards", "shuffled"])
def test_the_same_bytes_again_in_any_order_of_threads(on_the_cpu: Emulator, order: int) -> None:
    found = []
    for on_the_cpu.order in (0, order):
        result = align(there(seen(10, 48, 36)), there(seen(12, 48, 36)), np.eye(4), 3)
        found.append((result.T_live_reference.tobytes(), result.covariance.tobytes(), result.cost, result.steps))
    assert found[0] == found[1]


def test_the_host_waits_once_for_a_pose_and_once_for_its_covariance() -> None:
    reference, live = there(seen(10, 48, 36, True)), there(seen(12, 48, 36))
    with Watch() as watch:
        found = align(reference, live, np.eye(4), 2)
        assert watch.reads == 2, "one copy, and that as an array"
        found.covariance  # noqa: B018
    assert watch.reads == 4


def test_halving_makes_no_host_wait() -> None:
    gray, depth, weight = torch.rand(3, 60, 80)
    with Watch() as watch:
        Pyramid.of(gray, depth, Camera(80, 60, 70.0, 70.0, 39.5, 29.5), weight, backend="cuda")
    assert watch.reads == 0
