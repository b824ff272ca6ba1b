"""Exports of a handmade run: views, images, points, films and the floor plan agree with the run."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from box_room import CAMERA, HIGH, LOW, seer, splats
from films import read_film
from room_run import FRAMES, LOST, PATH, T_ROOM, WORLD, made_run, picture
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.trajectory import Component
from sigmasplat.errors import RunError
from sigmasplat.plugins.evaluation.reconstruct import FusionInput
from sigmasplat.plugins.outputs.colmap import export_colmap, splat_points
from sigmasplat.plugins.outputs.drawing.view_panels import FOOT, GAP, HEAD, PANEL_WIDTH
from sigmasplat.plugins.outputs.floorplan.picture import export_plan
from sigmasplat.plugins.outputs.mesh_files import write_mesh
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.plugins.outputs.video import Film, export_video, film_camera, image_count, orbit_view, swing
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd


@pytest.fixture(params=["submaps", "in one piece"])
def reader(tmp_path: Path, request: pytest.FixtureRequest) -> RunReader:
    return RunReader(made_run(tmp_path / "run", request.param == "submaps"))


def images(model: Path) -> list[list[str]]:
    """Return the words of each image's line."""
    return [line.split() for line in (model / "sparse/0/images.txt").read_text().split("\n")[1:-1:2]]


def positions(model: Path) -> np.ndarray:
    rows = np.array([[float(word) for word in line[1:8]] for line in images(model)])
    R = Rotation.from_quat(np.roll(rows[:, :4], -1, axis=1)).inv()
    return -R.apply(rows[:, 4:])


def test_a_damaged_camera_is_refused_in_one_line(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", submaps=False)
    for camera in ({}, {"width": 4}, {"fx": "x"}):
        run.note(camera=camera)
        with pytest.raises(RunError, match=r"run\.json: its camera cannot be used"):
            _ = RunReader(run).camera


def test_views_without_images_are_all_frames_that_were_not_lost(reader: RunReader, tmp_path: Path) -> None:
    kept = [i for i in range(FRAMES) if i != LOST]
    export_colmap(reader, tmp_path / "model")
    assert [line[-1] for line in images(tmp_path / "model")] == [f"frame-{i:06d}.png" for i in kept]
    np.testing.assert_allclose(positions(tmp_path / "model"), PATH.T_world_camera[kept, :3, 3], atol=1e-9)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model", "run"]


def test_images_are_those_of_the_keyframes_each_once(reader: RunReader, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    if not len(reader.run.submaps):
        with pytest.raises(RunError, match="kept no submaps, so it has no images; leave out --pictures"):
            export_colmap(reader, out, images=True)
        return
    export_colmap(reader, out, images=True)
    names = [f"frame-{i:06d}.png" for i in (0, 2, 4)]
    assert [line[-1] for line in images(out)] == sorted(p.name for p in (out / "images").iterdir()) == names
    np.testing.assert_allclose(positions(out), PATH.T_world_camera[[0, 2, 4], :3, 3], atol=1e-9)
    for i, name in zip((0, 2, 4), names, strict=True):
        np.testing.assert_array_equal(np.asarray(Image.open(out / "images" / name)), picture(i).color)
    assert (out / "sparse/0/cameras.txt").read_text().split("\n")[1].startswith("1 PINHOLE 40 30 ")


def test_splat_centres_are_thinned_evenly(reader: RunReader) -> None:
    points, colors = splat_points(reader.run.read_map(), most=100)
    assert points.shape == colors.shape == (100, 3)
    in_room = points @ T_ROOM[:3, :3].T + T_ROOM[:3, 3]
    np.testing.assert_allclose(in_room[:, 2], 0.0, atol=1e-5)
    assert in_room[:, 1].min() < LOW[1] + 0.2 and in_room[:, 1].max() > HIGH[1] - 0.2


def test_surface_normals_point_into_the_room(reader: RunReader, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="the [dev] extra is not installed")
    renderer = _from_any_submap(reader)
    surface = FusionInput.at(reader.run, reader.camera).surface(voxel_m=0.05, renderer=renderer)
    write_mesh(tmp_path / "mesh.ply", surface)
    cloud = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert len(cloud.vertices) == len(surface.vertices) > 500
    rows = cloud.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([rows[name].ravel() for name in ("nx", "ny", "nz")], 1) @ T_ROOM[:3, :3].T
    at = cloud.vertices @ T_ROOM[:3, :3].T + T_ROOM[:3, 3]
    floor = (np.abs(at[:, 2]) < 0.02) & (np.abs(at[:, :2] - 0.3).max(1) < 0.8)
    assert floor.sum() > 50 and np.quantile(normals[floor, 2], 0.1) > 0.9, "except at the edges of the surface"
    assert np.abs(cloud.visual.vertex_colors[:, :3].astype(int) - 128).max() <= 1


def test_a_surface_has_the_standard_deviation_of_the_nearest_opaque_splat(reader: RunReader) -> None:
    def surface() -> Mesh:
        renderer = _from_any_submap(reader)
        return FusionInput.at(reader.run, reader.camera).surface(voxel_m=0.1, renderer=renderer)

    assert surface().depth_std_m is None
    field = reader.run.read_map()
    std = SplatStd(torch.rand(len(field), generator=torch.Generator().manual_seed(0)) * 0.1, torch.ones(len(field)))
    reader.run.write_uncertainty(
        MapUncertainty(torch.zeros(len(field), 3), Background((0.5, 0.5, 0.5), 0.1, 1.0), SHIPPED, std=std)
    )
    found, known = surface(), reader.run.read_splat_std()
    assert known is not None and found.depth_std_m is not None
    opaque = field.opacities >= 0.5
    for k in range(0, len(found.vertices), 100):
        away_m = (field.means[opaque] - torch.from_numpy(found.vertices[k])).norm(dim=1)
        near = away_m <= away_m.min() + 1e-6
        assert float(found.depth_std_m[k]) in known[1].depth_std_m[opaque][near].tolist()


def test_an_uncertainty_of_another_map_is_refused(reader: RunReader) -> None:
    std = SplatStd(torch.ones(7), torch.ones(7))
    reader.run.write_uncertainty(
        MapUncertainty(torch.ones(7, 3), Background((0.5, 0.5, 0.5), 0.1, 1.0), SHIPPED, std=std)
    )
    with pytest.raises(RunError, match="run it again"):
        reader.run.read_splat_std()


def _from_any_submap(reader: RunReader):
    """Return a renderer of the room that tells the submaps apart by the number of calls."""
    anchors = [np.eye(4)] * 3
    if len(reader.run.submaps):
        anchors = [PATH.T_world_camera[0], PATH.T_world_camera[0], PATH.T_world_camera[2], PATH.T_world_camera[2]]
    calls = iter(anchors)
    return lambda _, camera, T: seer(se3.inverse(next(calls)) @ WORLD, boxes=())(_, camera, T)


@pytest.mark.parametrize("path", ["run", "orbit"])
def test_films_follow_the_path_or_an_orbit(reader: RunReader, tmp_path: Path, path: str) -> None:
    calls: list[tuple[int, int]] = []
    count = export_video(
        reader, tmp_path / "film.mp4", width_px=64, fps=5.0, seconds=1.0, orbit=path == "orbit", renderer=seer(WORLD),
        progress=lambda *at: calls.append(at),
    )  # fmt: skip
    frames, _ = read_film(tmp_path / "film.mp4")
    first = frames[0]
    assert (first.shape, len(frames), count) == ((48, 3 * 64, 3), 5, 5)
    assert calls == [(i, 5) for i in range(6)]
    assert np.abs(first[8:40, 4:60].astype(int) - 128).max() < 12, "colour on the left"
    assert first[8:40, 64:128].std(axis=(0, 1)).max() > 10, "depth in the middle"


def test_a_film_of_colour_alone_has_one_panel_and_no_legend(reader: RunReader, tmp_path: Path) -> None:
    options = {"width_px": 64, "fps": 5.0, "seconds": 1.0, "panels": False}
    assert export_video(reader, tmp_path / "film.mp4", **options, renderer=seer(WORLD)) == 5
    first = read_film(tmp_path / "film.mp4")[0][0]
    assert first.shape == (48, 64, 3) and np.abs(first.astype(int) - 128).max() < 12


def test_the_orbit_view_removes_the_ceiling_and_shows_most_of_the_room() -> None:
    high = GaussianField.from_values(torch.tensor([[0.0, 0.0, 2.4]]), torch.tensor([0.1]), torch.ones(1, 3))
    field = splats(WORLD)
    floor_splats = len(field)
    field.append(high.moved(torch.from_numpy(WORLD)))
    film, poses = orbit_view(Film(field, CAMERA, seer(WORLD)), PATH, 4)
    assert len(film.field) == floor_splats and len(field) == floor_splats + 1, "the map itself is not changed"
    points = field.means[:floor_splats].numpy()
    inside = [
        np.mean((np.abs(CAMERA.fx * x / z) < CAMERA.width / 2) & (np.abs(CAMERA.fy * y / z) < CAMERA.height / 2))
        for x, y, z in (((points - T[:3, 3]) @ T[:3, :3]).T for T in poses)
    ]
    assert np.mean(inside) > 0.6 and min((T_ROOM @ T)[2, 3] for T in poses) > 0.5, "above the floor"


def test_an_orbit_turns_fully_or_swings_where_the_map_covers_the_image() -> None:
    full, share = swing(np.full(24, 0.8), 8)
    np.testing.assert_allclose(full, np.pi / 4 * np.arange(8))
    assert share == pytest.approx(0.8)
    covered = np.where(np.isin(np.arange(24), [22, 23, 0, 1, 2]), 0.9, 0.3)
    covered[12] = 0.85  # well covered too, but not beside the best direction
    angles, share = swing(covered, 100)
    assert share == pytest.approx(0.9)
    away = np.angle(np.exp(1j * angles))
    assert np.abs(away).max() == pytest.approx(2 * np.pi / 12, rel=0.01) and angles[0] == pytest.approx(angles[50])


def test_films_hide_splats_seen_from_behind_and_what_is_not_sure(reader: RunReader, tmp_path: Path) -> None:
    field = reader.run.read_map()
    toward = torch.zeros(len(field), 3)
    toward[::2, 2] = 1.0  # seen from +z only; the directions of the others are not known
    std = SplatStd(torch.where(torch.arange(len(field)) % 3 > 0, 1e-4, 9.0), torch.ones(len(field)))
    splats = torch.cat([torch.zeros(len(field), 3), toward], 1)
    reader.run.write_uncertainty(MapUncertainty(splats, Background((0.5, 0.5, 0.5), 0.1, 1.0), SHIPPED, std=std))
    shown: list[int] = []

    def count(field: GaussianField, camera: Camera, T: np.ndarray, reference: object = None) -> object:
        shown.append(len(field))
        return seer(WORLD)(field, camera, T)

    far = np.eye(4)
    far[2, 3] = -100.0
    sure = int((std.depth_std_m < 1.0).sum())
    for options, kept in (({}, sure), ({"uncertain": True}, len(field)), ({"std_below_m": 1e-3}, sure)):
        film = Film.of(reader, CAMERA, count, **options)
        film.seen(far)
        assert len(film.field) == kept
        assert (shown[-1] == kept) == ("uncertain" in options) and shown[-1] > 0.4 * kept
    with pytest.raises(RunError, match="use a weaker bound"):
        Film.of(reader, CAMERA, count, std_below_m=1e-9)


def test_the_length_and_the_size_of_a_film(reader: RunReader, tmp_path: Path) -> None:
    assert image_count(0.5) == 100 and image_count(500.0, fps=10.0) == 200
    assert image_count(500.0, fps=10.0, orbit=True) == 120
    camera = film_camera(Camera(321, 241, 200.0, 200.0, 160.0, 120.0), 0)
    assert (camera.width, camera.height) == (320, 240)
    export_video(reader, tmp_path / "film.mp4", width_px=200, fps=5.0, seconds=0.2, renderer=seer(WORLD))
    shown = read_film(tmp_path / "film.mp4")[0][0].astype(int)
    assert shown.shape == (150 + HEAD + FOOT, 3 * 200 + 4 * GAP, 3), "panels with titles and colour bars"
    bar = shown[HEAD + 150 + FOOT // 2, 2 * GAP + 200 + 80 : 2 * GAP + 400 - 80]
    assert (np.ptp(bar, axis=0) > 60).all() and shown[:HEAD, 2 * GAP + 200 :].max() > 150


def test_the_plan_is_an_image_and_a_json_file(reader: RunReader, tmp_path: Path) -> None:
    plan = export_plan(reader, tmp_path / "plan.png")
    with Image.open(tmp_path / "plan.png") as drawn:
        assert drawn.format == "PNG" and drawn.size[0] >= PANEL_WIDTH + 2 * GAP
    record = json.loads((tmp_path / "plan.json").read_text())
    assert len(record["cells"]) == plan.kind.shape[0] and len(plan.path_m) == FRAMES - 1, "without the lost frame"
    with pytest.raises(RunError, match=r"give a name that ends in \.png"):
        export_plan(reader, tmp_path / "plan.pdf")


@pytest.fixture
def reader_apart(tmp_path: Path) -> RunReader:
    """A run whose second submap, with its keyframe 4 and the frames after it, is not connected to the world."""
    run = made_run(tmp_path / "run", submaps=True)
    log, apart = run.read_log(), (4, 5)
    for i, record in enumerate(log):
        record |= {"submap": int(i in apart), "state": "lost" if i == LOST else "apart" if i in apart else "tracked"}
    (run.path / "log.jsonl").write_text("".join(json.dumps(record) + "\n" for record in log))
    run.write_trajectory(PATH.at(np.array([0, 1, 2])))
    run.write_components([Component(1, splats(WORLD), PATH.at(np.array([4, 5])))])
    return RunReader(run)


def test_frames_apart_are_not_exported(reader_apart: RunReader, tmp_path: Path) -> None:
    reader, out = reader_apart, tmp_path / "out"
    assert export_colmap(reader, tmp_path / "all") == 3 and reader.left_out() == "; left out: 1 lost, 2 apart"
    assert export_colmap(reader, out, images=True) == 2 and reader.left_out(keyframes=True) == "; left out: 1 apart"
    assert sorted(p.name for p in (out / "images").iterdir()) == ["frame-000000.png", "frame-000002.png"]
    _, keyframes = FusionInput.at(reader.run, reader.camera).views()
    assert keyframes == 2, "those of the first submap"
    assert len(reader.valid_path()) == 3
    with pytest.raises(RunError, match="no valid pose of frame 4"):
        reader.poses_of([0, 4])


def test_runs_without_a_pose_are_refused(reader: RunReader, tmp_path: Path) -> None:
    log = reader.run.path / "log.jsonl"
    log.write_text(log.read_text().replace('"lost": false', '"lost": true'))
    with pytest.raises(RunError, match="has no frame whose pose is known"):
        export_colmap(reader, tmp_path / "model")
    (reader.run.path / "trajectory.txt").unlink()
    with pytest.raises(RunError, match=r"no trajectory\.txt"):
        export_colmap(RunReader(reader.run), tmp_path / "model")
