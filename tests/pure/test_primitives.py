"""Uncertainty of single splats: held to a plain loop over pixels; what it blames, and what second chance it gives."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from constants import changed
from paper_settings import MappingConfig, RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.densify import depths, fade, splat_uncertainty, still_uncertain
from sigmasplat.render.backend import make_view
from sigmasplat.render.render import render
from sigmasplat.render.view import View

Array = NDArray[np.float64]
CAMERA = Camera(20, 15, 18.0, 18.5, 9.3, 7.4)
PIXELS = 20 * 15
OPTIONS = RenderConfig()
UNCERTAIN_M2 = 0.025
OPACITY = COLUMNS["opacity_logits"].start


@pytest.fixture(params=["reference", "cpu"])
def view(request: pytest.FixtureRequest) -> View:
    if request.param == "cpu":
        pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built")
    return make_view(request.param, CAMERA, OPTIONS)


def keyframe(view: View, T_camera_world: Array, depth_m: Array | float, index: int = 0) -> Keyframe:
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), (CAMERA.height, CAMERA.width)).copy()
    frame = Frame(index, 0.0, np.full((*depth.shape, 3), 0.5, np.float32), depth, CAMERA)
    target = Target.of(frame, (view.alpha.shape[0], view.alpha.shape[1]))
    return Keyframe(index, target, se3.inverse(T_camera_world))


def cloud(n: int = 60) -> GaussianField:
    """Scatter splats before the camera, some of them behind it."""
    random = np.random.default_rng(1)
    means = random.uniform([-1.2, -1.0, -0.5], [1.2, 1.0, 3.0], (n, 3))
    values = [torch.from_numpy(a).float() for a in (means, random.uniform(0.05, 0.3, (n, 3)), random.random((n, 3)))]
    opacities = torch.from_numpy(random.uniform(0.1, 0.95, n)).float()
    return GaussianField.from_values(*values, quats=torch.randn(n, 4, generator=torch.Generator().manual_seed(0)),
                                     opacities=opacities)  # fmt: skip


def window(view: View) -> list[Keyframe]:
    """Look at the cloud from three sides, with readings about where it is and holes."""
    random = np.random.default_rng(2)
    frames = []
    for k, twist in enumerate(random.uniform(-0.2, 0.2, (3, 6))):
        depth = random.uniform(0.5, 3.0, (CAMERA.height, CAMERA.width))
        depth[random.random(depth.shape) < 0.3] = 0.0
        frames.append(keyframe(view, se3.exp(twist), depth, k))
    return frames


def wall_and_floater() -> GaussianField:
    """Make a wall at 2 m, a splat per pixel, and a floater at 1 m before its middle: the last row."""
    rays = CAMERA.rays().reshape(-1, 3)
    means = np.concatenate([2.0 * rays, [[0.0, 0.0, 1.0]]]).astype(np.float32)
    n = len(means)
    scales = torch.full((n,), 2.0 / CAMERA.fx)
    return GaussianField.from_values(torch.from_numpy(means), scales, torch.full((n, 3), 0.5), opacities=0.9)


def plain_uncertainty(field: GaussianField, keyframes: list[Keyframe]) -> tuple[Array, Array]:
    """Do eq. 13 pixel by pixel, on the definition's maps."""
    total, count = np.zeros(len(field)), np.zeros(len(field))
    for frame in keyframes:
        T = np.linalg.inv(frame.T_world_camera)
        shown = render(field, CAMERA, T, options=OPTIONS, backend="reference")
        owners, weights = shown.dominant_id, shown.dominant_weight
        for row in range(CAMERA.height):
            for column in range(CAMERA.width):
                reading, i = float(frame.target.depth[row, column]), int(owners[row, column])
                if reading > 0 and i >= 0:
                    z = float(T[2, :3] @ field.means[i].double().numpy() + T[2, 3])
                    total[i] += float(weights[row, column]) * (reading - z) ** 2
                    count[i] += 1
    return total / np.maximum(count, 1), count


def test_uncertainty_agrees_with_a_loop_over_pixels(view: View) -> None:
    field, keyframes = cloud(), window(view)
    found, pixels = splat_uncertainty(field, view, keyframes)
    expected, count = plain_uncertainty(field, keyframes)
    assert (count > 0).sum() > 10 and (count == 0).sum() > 10
    np.testing.assert_array_equal(pixels.numpy(), count)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4, atol=1e-7)


def test_the_window_is_a_mean_over_all_its_pixels(view: View) -> None:
    field, keyframes = cloud(), window(view)
    one_by_one = [splat_uncertainty(field, view, [frame]) for frame in keyframes]
    together, pixels = splat_uncertainty(field, view, keyframes)
    total = sum((u * n for u, n in one_by_one), torch.zeros(len(field)))
    torch.testing.assert_close(together * pixels, total)
    nothing, none = splat_uncertainty(field, view, [])
    assert nothing.tolist() == none.tolist() == [0] * len(field)


def test_a_floater_is_uncertain_and_the_wall_is_not(view: View) -> None:
    field = wall_and_floater()
    keyframes = [keyframe(view, se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])), 2.0) for x in (0.0, 0.3, -0.2)]
    found, pixels = splat_uncertainty(field, view, keyframes)
    assert float(found[-1]) > 10 * UNCERTAIN_M2 and int(pixels[-1]) > 3
    assert float(found[:-1].max()) < 1e-6 and int((pixels[:-1] > 0).sum()) > PIXELS // 2


def test_pixels_without_reading_change_nothing(view: View) -> None:
    field, holes = wall_and_floater(), np.full((CAMERA.height, CAMERA.width), 2.0)
    owned = render(field, CAMERA, np.eye(4), options=OPTIONS, backend="reference").dominant_id.numpy() == PIXELS
    holes[owned] = 0.0
    found, pixels = splat_uncertainty(field, view, [keyframe(view, np.eye(4), holes)])
    assert owned.any() and int(pixels[-1]) == 0 and float(found[-1]) == 0.0
    assert int(pixels.sum()) == int((~owned).sum())
    blind = keyframe(view, se3.exp(np.array([0.1, 0.0, 0.2, 0.0, 0.1, 0.0])), 0.0)
    again, _ = splat_uncertainty(field, view, [blind, keyframe(view, np.eye(4), holes)])
    assert torch.equal(again, found)


def test_moving_field_and_cameras_together_changes_nothing(view: View) -> None:
    field, keyframes = cloud(), window(view)
    move = se3.exp(np.array([0.5, -0.3, 0.8, 0.4, -1.1, 0.7]))
    moved = [replace(frame, T_world_camera=move @ frame.T_world_camera) for frame in keyframes]
    found, pixels = splat_uncertainty(field, view, keyframes)
    carried, pixels_then = splat_uncertainty(field.moved(torch.from_numpy(move)), view, moved)
    assert int((pixels != pixels_then).sum()) <= 2, "rounding may turn a pixel or two"
    same = pixels == pixels_then
    torch.testing.assert_close(carried[same], found[same], rtol=1e-3, atol=1e-5)


def test_an_empty_field_has_no_uncertainty(view: View) -> None:
    found, pixels = splat_uncertainty(GaussianField.empty(), view, window(view))
    assert len(found) == len(pixels) == 0


def test_depths_are_the_third_camera_coordinate() -> None:
    points, T = np.random.default_rng(0).normal(size=(5, 3)), se3.exp(np.array([1.0, 2.0, 3.0, 0.3, 0.2, -0.9]))
    np.testing.assert_allclose(depths(points, T), (points @ T[:3, :3].T + T[:3, 3])[:, 2])


def aged(opacities: list[float]) -> GaussianField:
    """Make splats with moments everywhere."""
    n = len(opacities)
    field = GaussianField.from_values(
        torch.rand(n, 3), torch.ones(n), torch.rand(n, 3), opacities=torch.tensor(opacities)
    )
    field.moment1, field.moment2 = torch.rand(n, 17) + 1.0, torch.rand(n, 17) + 1.0
    field.last_step, field.steps = torch.full((n,), 7, dtype=torch.int32), 7
    return field


@pytest.mark.parametrize("rows", [torch.tensor([False, True, True, True]), torch.tensor([1, 2, 3])])
def test_fading_lowers_opacity_and_never_raises_it(rows: Tensor) -> None:
    field = aged([0.9, 0.9, 0.05, 0.0701])
    field.ids += 40
    before = field.copy_to(torch.device("cpu"))
    assert fade(field, rows, 0.07).tolist() == [41, 42, 43]
    torch.testing.assert_close(field.opacities, torch.tensor([0.9, 0.07, 0.05, 0.07]))
    other = [k for k in range(17) if k != OPACITY]
    for name in ("params", "moment1", "moment2"):
        assert torch.equal(getattr(field, name)[:, other], getattr(before, name)[:, other]), name
    for moment, old in ((field.moment1, before.moment1), (field.moment2, before.moment2)):
        assert moment[1:, OPACITY].tolist() == [0.0] * 3 and moment[0, OPACITY] == old[0, OPACITY]
    assert torch.equal(field.last_step, before.last_step)


def test_nothing_faded_nothing_changed() -> None:
    field = aged([0.9, 0.5])
    before = field.copy_to(torch.device("cpu"))
    assert fade(field, torch.zeros(2, dtype=torch.bool), 0.07).tolist() == []
    assert all(torch.equal(a, b) for a, b in zip(field._tensors, before._tensors, strict=True))


def test_faded_splats_go_unless_they_came_back() -> None:
    #      not faded: faint, uncertain | faded: faint, uncertain, back on both counts, both | gone
    field = aged([0.01, 0.9, 0.05, 0.3, 0.3, 0.02])
    uncertainty = torch.tensor([0.0, 9.0, 0.0, 0.03, 0.02, 0.03])
    faded = field.ids[2:].clone()
    gone = still_uncertain(field, faded, uncertainty, UNCERTAIN_M2, 15 / 255)
    assert gone.tolist() == [False, False, True, True, False, True]
    order = torch.tensor([4, 5, 0, 3])
    field.keep(order)
    field.append(aged([0.01, 0.01]))
    uncertainty = torch.cat([uncertainty[order], torch.tensor([9.0, 9.0])])
    moved = still_uncertain(field, faded, uncertainty, UNCERTAIN_M2, 15 / 255)
    assert moved.tolist() == [False, True, False, True, False, False]
    assert not still_uncertain(field, faded[:0], uncertainty, UNCERTAIN_M2, 15 / 255).any()


def test_a_faded_splat_of_the_wall_comes_back_and_a_floater_does_not(view: View) -> None:
    field = wall_and_floater()
    lonely = int(((field.means[:-1, :2] - torch.tensor([0.6, 0.4])).norm(dim=1)).argmin())
    field.params[:, COLUMNS["colors"]] = 0.9
    field.params[-1, COLUMNS["colors"]] = 0.0
    frame = keyframe(view, np.eye(4), 2.0)
    frame.target.color[:, : CAMERA.height, : CAMERA.width] = 0.9
    faded = fade(field, torch.tensor([lonely, PIXELS]), 0.07)
    still = changed(MappingConfig(), weight_nll_color=0.0, lr_means=0.0, lr_log_scales=0.0, lr_quats=0.0, lr_colors=0.0)
    fit_field(field, view, [[frame]] * 15, still)
    uncertainty, _ = splat_uncertainty(field, view, [frame])
    opacity = field.opacities
    assert float(opacity[lonely]) > 0.07 > float(opacity[-1]), "the images decide"
    gone = still_uncertain(field, faded, uncertainty, UNCERTAIN_M2, 15 / 255)
    assert gone.nonzero().squeeze(1).tolist() == [PIXELS]
