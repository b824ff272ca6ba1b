"""On a CUDA device: alignment held to the CPU's and to its definition, the same bytes twice, a short run of SLAM.

Skipped without a device. For memory errors run this file under compute-sanitizer.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from align_oracle import HUGE, oracle, pair
from paper_settings import TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit import align as aligning
from sigmasplat.fit.align import align
from sigmasplat.fit.cpu import CPU_IMAGES
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, live_image, map_reference
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.images import CUDA_IMAGES, MOTIONS
from sigmasplat.plugins.cuda.view import CudaView
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.view import View
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.slam import Slam
from splat_fields import OPTIONS
from splat_wall import CAMERA, TRUTH, seen_from, wall
from test_cuda_align import assert_same, level_of, room, seen, there
from test_cuda_fits import settings

_core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
REASON = cuda_launch.missing()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))


@pytest.mark.parametrize("size", [(640, 480), (97, 69), (33, 32)], ids=str)
def test_pyramids_are_the_cpus_to_the_bit(size: tuple[int, int]) -> None:
    want = seen(10, *size, weighed=True)
    got = there(want, "cuda")
    for name in ("gray", "depth", "weight", "weight_depth"):
        for ours, theirs in zip(getattr(got, name), getattr(want, name), strict=True):
            np.testing.assert_array_equal(ours.cpu().numpy(), theirs)
    assert isinstance(got.readings, torch.Tensor)
    np.testing.assert_allclose(got.readings.cpu().numpy(), want.readings, rtol=1e-6)


@pytest.mark.parametrize("holes", [False, True], ids=["whole", "holes"])
@pytest.mark.parametrize("huber", [(HUGE, HUGE), (0.05, 0.004)], ids=["quadratic", "huber"])
def test_normal_equations_are_the_cpus_and_those_of_the_residuals(huber: Any, holes: bool) -> None:
    p = pair(*huber, holes)
    motions = [p.T] * MOTIONS
    got = aligning.normal_equations(CUDA_IMAGES, level_of(p, device="cuda"), motions)
    (want,), (H, b, sums, _) = aligning.normal_equations(CPU_IMAGES, level_of(p), [p.T]), oracle(p)
    for n in got:
        np.testing.assert_array_equal(n.sums[1:], sums[1:])
        for ours, theirs, exact in ((n.H, want.H, H), (n.b, want.b, b), (n.sums[:1], want.sums[:1], sums[:1])):
            assert np.linalg.norm(ours - theirs) < 1e-5 * np.linalg.norm(theirs)
            assert np.linalg.norm(ours - exact) < 1e-3 * np.linalg.norm(exact)
        assert np.linalg.norm(n.S - want.S) < 1e-5 * np.linalg.norm(want.S)


@pytest.mark.parametrize("size", [(640, 480), (161, 119)], ids=str)
@pytest.mark.parametrize("weighed", [False, True])
def test_two_images_are_aligned_as_on_the_cpu(size: tuple[int, int], weighed: bool) -> None:
    reference, live = seen(10, *size, weighed), seen(12, *size)
    theirs, ours = (
        align(reference, live, np.eye(4), 15),
        align(there(reference, "cuda"), there(live, "cuda"), np.eye(4), 15),
    )
    assert_same(ours, theirs, 1e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(ours.covariance)), np.sqrt(np.diag(theirs.covariance)), rtol=2e-2)


def test_two_runs_give_identical_bytes() -> None:
    found = []
    for _ in range(20):
        result = align(there(seen(10, 640, 480), "cuda"), there(seen(12, 640, 480), "cuda"), np.eye(4), 15)
        found.append((result.T_live_reference.tobytes(), result.covariance.tobytes(), result.cost, result.steps))
    assert len(set(found)) == 1


def test_with_nothing_in_common_the_guess_comes_back() -> None:
    image, guess = seen(10), se3.exp(np.array([0.01, 0.0, 0.02, 0.0, 0.01, 0.0]))
    dark = there(Pyramid.of(image.gray[0], np.zeros_like(image.depth[0]), image.cameras[0]), "cuda")
    found = align(dark, there(seen(12), "cuda"), guess, 5)
    np.testing.assert_allclose(found.T_live_reference, guess, atol=1e-12)
    assert found.overlap == 0.0 and found.degenerate == 6 and not np.isfinite(found.covariance.diagonal()).any()


@pytest.mark.parametrize("depth_by", ["V", "U"])
@pytest.mark.parametrize("kind", ["map", "keyframe"])
def test_references_are_the_cpus_and_stay_there(kind: str, depth_by: str, tmp_path: Path) -> None:
    config, found = TrackingConfig(tau=3.0, weight_max=2.0, align_depth_by=depth_by), []
    for view in (CudaView(CAMERA, OPTIONS), CpuView(CAMERA, OPTIONS)):
        found.append(made(kind, view, config))
    got, want = (reference.pyramid for reference in found)
    for name in ("gray", "depth", "weight", "weight_depth"):
        for ours, theirs in zip(getattr(got, name), getattr(want, name), strict=True):
            assert ours.is_cuda
            np.testing.assert_allclose(ours.cpu().numpy(), theirs, atol=5e-4)
    write_state(tmp_path / "state", found[0], (Reference, Pyramid, Camera), {})
    again = read_state(tmp_path / "state", (Reference, Pyramid, Camera), {})
    assert all(torch.equal(a, b) for a, b in zip(again.pyramid.weight, got.weight, strict=True))


def made(kind: str, view: View, config: TrackingConfig) -> Reference:
    target = seen_from(CpuView(CAMERA, OPTIONS), TRUTH)
    h, w = view.alpha.shape
    target.color, target.depth = target.color[:, :h, :w].contiguous(), target.depth[:h, :w].contiguous()
    if kind == "map":
        return map_reference(wall(), view, TRUTH, config)
    image = live_image(view, target.image.numpy(), target.depth_image.numpy(), target)
    return keyframe_reference(wall(), view, image, TRUTH, config)


def test_slam_tracks_by_alignment_as_on_the_cpu() -> None:
    paths = []
    for backend in ("cuda", "cpu"):
        slam = Slam(settings(backend=backend, input__width="160", mapping__first_iterations="60"))
        for i in range(8):
            slam.step(room(160, 120).frame(i))
        paths.append(slam.trajectory().T_world_camera)
    np.testing.assert_allclose(paths[0], paths[1], atol=2e-2)
    assert np.ptp(paths[0][:, :3, 3], axis=0).max() > 1e-2, "the camera moves"
