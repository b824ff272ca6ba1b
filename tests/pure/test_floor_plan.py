"""Floor plans of a synthetic room: walls, objects and predicted errors are at their true places in any world frame."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from box_room import CAMERA, CHEST, HIGH, LOW, PILLAR, cast, pose, seer, splats, walk
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.files.json_files import write_json
from sigmasplat.plugins.outputs.drawing.view_panels import BACKGROUND, GAP, HEAD, PANEL_WIDTH
from sigmasplat.plugins.outputs.floorplan.floor_plan import (
    CELL_M,
    FLOOR_UNOBSERVED,
    FREE,
    OBJECT,
    SIGNS,
    UNOBSERVED,
    WALL,
    FloorPlan,
    floor_plan,
)
from sigmasplat.plugins.outputs.floorplan.ground import floor_frame, sample_surface, sample_surfaces
from sigmasplat.plugins.outputs.floorplan.picture import KIND_COLOURS, draw_floor_plan, plan_panels
from sigmasplat.uncertainty.predictive import Predicted

WORLD = se3.exp(np.array([3.0, -2.0, 1.0, 1.9, 0.4, -0.3]))
UPRIGHT = np.eye(4)


def patch(low: tuple[float, float], high: tuple[float, float]):
    """Return a function that tests whether points [..., 3] are above this rectangle of the floor."""

    def inside(at: np.ndarray) -> np.ndarray:
        return ((at[..., :2] > low) & (at[..., :2] < high)).all(-1) & (at[..., 2] < 0.3)

    return inside


def plan_of(T_world_room: np.ndarray = UPRIGHT, **known) -> FloorPlan:
    predictor = known.pop("predictor", None)
    return floor_plan(
        splats(T_world_room), walk(T_world_room), CAMERA, renderer=seer(T_world_room, **known), predictor=predictor
    )


def seer_of_errors(
    T_world_room: np.ndarray,
    depth_std_m: Callable[[np.ndarray], np.ndarray],
    color_std: Callable[[np.ndarray], np.ndarray],
) -> Callable[..., Predicted]:
    """Return a predictor of standard deviations that are functions of the place in the room [..., 3]."""

    def predict(camera: Camera, T_camera_world: np.ndarray) -> Predicted:
        T_room_camera = se3.inverse(T_world_room) @ se3.inverse(T_camera_world)
        rays = camera.rays().astype(float) @ T_room_camera[:3, :3].T
        eye = T_room_camera[:3, 3]
        at = eye + rays * cast(eye, rays, [PILLAR, CHEST])[..., None]
        color, depth = (torch.tensor(std(at) ** 2, dtype=torch.float32) for std in (color_std, depth_std_m))
        return Predicted(0.5 * color, 0.5 * color, 0.25 * depth, 0.75 * depth, depth)

    return predict


@cache
def plain_plan() -> FloorPlan:
    return plan_of()


def kind_at(plan: FloorPlan, x: float, y: float) -> int:
    """Return the kind of the cell at x, y of the room. The plan has its origin below the first camera, at (0, 0.3)."""
    column, row = np.floor((np.array([x, y - 0.3]) - plan.origin_m) / plan.cell_m).astype(int)
    return int(plan.kind[row, column])


def test_the_floor_is_found_in_any_world_frame() -> None:
    """The frame has the axes of the room: z up from the floor, y in the viewing direction of the first camera."""
    for T_world_room in (UPRIGHT, WORLD):
        samples = list(
            sample_surfaces(splats(T_world_room), walk(T_world_room), CAMERA, seer(T_world_room), max_poses=8)
        )
        T_floor_room = floor_frame(samples) @ T_world_room
        np.testing.assert_allclose(T_floor_room[:3, :3], np.eye(3), atol=2e-3)
        np.testing.assert_allclose(T_floor_room[:3, 3], [0.0, -0.3, 0.0], atol=0.01)


def test_axes_follow_the_walls_even_if_the_camera_looks_diagonally() -> None:
    poses = np.stack([pose((0.0, 0.0, 1.4), yaw, -0.4) for yaw in np.deg2rad([70.0, 150.0, 230.0, 310.0])])
    samples = list(sample_surfaces(splats(UPRIGHT), Trajectory(np.arange(4.0), poses), CAMERA, seer(UPRIGHT)))
    np.testing.assert_allclose(floor_frame(samples)[:3, :3], np.eye(3), atol=5e-3)


@pytest.mark.parametrize("pitch", [0.0, 0.9])
def test_up_is_found_without_the_floor_in_view(pitch: float) -> None:
    """Walls or the ceiling give the direction. The lowest visible point then stands for the floor."""
    path = walk(WORLD, images=8, pitch=pitch)
    narrow = CAMERA.__class__(160, 120, 200.0, 200.0, 79.5, 59.5)
    samples = list(sample_surfaces(splats(WORLD), path, narrow, seer(WORLD)))
    assert floor_frame(samples)[2, :3] @ WORLD[:3, 2] > np.cos(np.deg2rad(2.0))


def test_samples_have_the_normals_and_areas_of_the_surfaces() -> None:
    sample = sample_surface(splats(UPRIGHT), CAMERA, pose((0.0, 0.0, 1.5), 0.3, -0.8), seer(UPRIGHT, boxes=()))
    off_walls = ((sample.points > np.add(LOW, [0.1, 0.1, -1.0])) & (sample.points < HIGH - 0.1)).all(1)
    on_floor = (sample.points[:, 2] < 1e-3) & off_walls
    np.testing.assert_allclose(sample.normals[on_floor], np.tile([0, 0, 1.0], (on_floor.sum(), 1)), atol=1e-3)
    low, high = [0.5, -0.5], [1.5, 0.5]
    part = on_floor & (sample.points[:, :2] > low).all(1) & (sample.points[:, :2] < high).all(1)
    assert sample.area_m2[part].sum() == pytest.approx(1.0, rel=0.05)


def test_walls_and_objects_are_at_their_true_places() -> None:
    plan = plain_plan()
    rows, columns = np.nonzero(plan.kind == WALL)
    x = plan.origin_m[0] + (columns + 0.5) * CELL_M
    y = plan.origin_m[1] + (rows + 0.5) * CELL_M + 0.3
    for found, true in ((x.min(), LOW[0]), (x.max(), HIGH[0]), (y.min(), LOW[1]), (y.max(), HIGH[1])):
        assert abs(found - true) <= CELL_M
    assert kind_at(plan, PILLAR[0][0] + 0.01, 0.7) == WALL, "near side of the pillar"
    assert kind_at(plan, -1.7, 0.0) == OBJECT and kind_at(plan, CHEST[1][0] + 0.12, 0.0) == FREE
    assert kind_at(plan, 0.0, 0.6) == FLOOR_UNOBSERVED, "below the camera"
    assert kind_at(plan, 1.1, 0.7) == UNOBSERVED, "inside the pillar"
    assert kind_at(plan, HIGH[0] + 0.15, 0.0) == UNOBSERVED, "beyond the wall"
    assert plan.area_m2(UNOBSERVED, FLOOR_UNOBSERVED, FREE, OBJECT, WALL) == pytest.approx(plan.kind.size * CELL_M**2)
    np.testing.assert_allclose(plan.path_m[0], [0.0, 0.0], atol=0.01)


@pytest.mark.parametrize("T_world_room", [UPRIGHT, WORLD])
def test_uncertain_and_thin_places_are_found_within_a_cell(T_world_room: np.ndarray) -> None:
    deep, thin, wrong = (
        patch((-1.2, -1.2), (-0.8, -0.8)),
        patch((0.6, -1.3), (1.1, -0.8)),
        patch((-1.4, 1), (-1, 1.4)),
    )
    errors = seer_of_errors(
        T_world_room, lambda at: np.where(deep(at), 0.08, 0.02), lambda at: np.where(wrong(at), 0.2, 0.02)
    )
    plan = plan_of(T_world_room, predictor=errors, alpha=lambda at: np.where(thin(at), 0.7, 1.0))
    y, x = plan.origin_m[::-1, None, None] + (np.indices(plan.kind.shape) + 0.5) * CELL_M
    place = np.stack([x, y + 0.3, np.zeros_like(x)], -1)
    for patch_of, values, inside_value, outside_value in (
        (deep, plan.depth_sigma_m, 0.08, 0.02), (thin, plan.alpha, 0.7, 1.0), (wrong, plan.wrong_share, 0.617, 0.0),
    ):  # fmt: skip
        floor = plan.kind == FREE
        shifted = [patch_of(place + np.array([dx, dy, 0.0])) for dx in (-CELL_M, CELL_M) for dy in (-CELL_M, CELL_M)]
        inside, outside = np.all(shifted, 0) & floor, ~np.any(shifted, 0) & floor
        assert inside.sum() > 20 and outside.sum() > 500
        np.testing.assert_allclose(values[inside], inside_value, atol=0.02)
        np.testing.assert_allclose(values[outside], outside_value, atol=0.02)
    assert plan.predicted_errors and plan.record()["predicted_errors"]
    assert np.nanmax(plan.wrong_share) == pytest.approx(0.617, abs=0.01)
    assert [panel.ends[1][-2:] for panel in plan_panels(plan)] == ["", " %", "cm"]


def test_a_plan_without_predicted_errors_shows_none() -> None:
    plan = plain_plan()
    assert not plan.predicted_errors and not plan.record()["predicted_errors"]
    assert np.isnan(plan.wrong_share).all() and np.isnan(plan.depth_sigma_m).all() and len(plan_panels(plan)) == 1


def test_what_is_not_observed_is_behind_the_pillar_and_below_the_camera() -> None:
    plan = plain_plan()
    assert kind_at(plan, *(np.add(PILLAR[0][:2], PILLAR[1][:2]) / 2)) == UNOBSERVED
    rows, columns = np.nonzero(plan.kind == FLOOR_UNOBSERVED)
    floor = plan.origin_m + (np.stack([columns, rows], 1) + 0.5) * CELL_M
    assert np.linalg.norm(floor.mean(0)) < 0.8, "around the camera"


def test_another_world_frame_changes_the_plan_by_rounding_only() -> None:
    here, there = plain_plan(), plan_of(WORLD)
    np.testing.assert_allclose(there.T_floor_world @ WORLD, here.T_floor_world, atol=2e-3)
    np.testing.assert_allclose(there.origin_m, here.origin_m, atol=1e-9)
    assert there.kind.shape == here.kind.shape and (there.kind == here.kind).mean() > 0.99
    both = np.isfinite(here.alpha) & np.isfinite(there.alpha)
    assert both.mean() > 0.4
    np.testing.assert_allclose(there.alpha[both], here.alpha[both], atol=1e-4)


def test_the_record_holds_frame_and_cells(tmp_path: Path) -> None:
    deep = patch((-1.2, -1.2), (-0.8, -0.8))
    errors = seer_of_errors(WORLD, lambda at: np.where(deep(at), 0.12, 0.01), lambda at: np.full(at.shape[:-1], 0.02))
    plan = plan_of(WORLD, predictor=errors)
    write_json(tmp_path / "plan.json", plan.record())
    record = json.loads((tmp_path / "plan.json").read_text())
    assert record["resolution_m"] == CELL_M and np.shape(record["T_floor_world"]) == (4, 4)
    assert [[SIGNS.index(sign) for sign in row] for row in record["cells"]] == plan.kind.tolist()


def test_the_picture_shows_the_cells_with_y_up() -> None:
    plan = plain_plan()
    picture = draw_floor_plan(plan)
    assert picture.getpixel((2, 2)) == BACKGROUND and picture.mode == "RGB"
    panel = plan_panels(plan)[0].pixels
    assert panel.shape[:2] == (round(plan.kind.shape[0] * panel.shape[1] / plan.kind.shape[1]), 2 * PANEL_WIDTH)
    for x, y, kind in ((-1.0, 1.2, FREE), (HIGH[0] + 0.15, 0.0, UNOBSERVED), (-1.7, 0.0, OBJECT)):
        assert kind_at(plan, x, y) == kind
        at = (np.array([x, y - 0.3]) - plan.origin_m) / plan.cell_m * PANEL_WIDTH / plan.kind.shape[1]
        column, row = int(at[0]), int(PANEL_WIDTH * plan.kind.shape[0] / plan.kind.shape[1] - at[1])
        assert tuple(panel[2 * row, 2 * column]) == tuple(KIND_COLOURS[kind])
        drawn = np.array(picture.getpixel((GAP + column, HEAD + row)))
        assert np.abs(drawn - KIND_COLOURS[kind]).max() <= 2


def test_bad_cells_and_maps_without_surfaces_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"0\.001 to 1 m wide, found 0"):
        floor_plan(splats(UPRIGHT), walk(UPRIGHT), CAMERA, cell_m=0.0, renderer=seer(UPRIGHT))
    nothing = seer(UPRIGHT, alpha=lambda at: np.zeros(at.shape[:-1]))
    with pytest.raises(SigmaSplatError, match="no surface of the map is visible"):
        floor_plan(splats(UPRIGHT), walk(UPRIGHT), CAMERA, renderer=nothing)


def test_progress_counts_the_poses() -> None:
    calls: list[tuple[int, int]] = []
    floor_plan(splats(UPRIGHT), walk(UPRIGHT, 3), CAMERA, renderer=seer(UPRIGHT), progress=lambda *at: calls.append(at))
    assert calls == [(1, 3), (2, 3), (3, 3)]
