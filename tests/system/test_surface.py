"""Surfaces of runs: of a map with exactly known renders, of a tiny real run, and of the synthetic room itself."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from command_line import exit_code
from paper_settings import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.files.json_files import write_json
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation import reconstruct
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.evaluation.metrics.reconstruction import distances
from sigmasplat.plugins.evaluation.reconstruct import FusionInput
from sigmasplat.plugins.outputs.mesh_files import read_mesh
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.run_folder.runs import RunFolder

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
"""The run works at half this size."""
CONFIG = replace(BASE, name="hand-made", input=InputConfig(width=48, max_depth_m=4.0))
KEYFRAMES, WALL_M, VOXEL_M = [0, 2, 4], 2.0, 0.05
WORLD = se3.exp(np.array([5.0, 6, 7, 0.5, 1.0, 1.5]))


@pytest.fixture(autouse=True)
def fewer_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare surfaces at a fifth of the usual number of points."""
    for of, name in (
        (reconstruct.reconstruction, "score"),
        (reconstruct, "score_published"),
        (reconstruct, "score_splats"),
    ):
        monkeypatch.setattr(of, name, partial(getattr(of, name), points=40_000))


def poses() -> np.ndarray:
    """Return six poses in front of a wall at z = 2 m; frames 1, 3 and 5 are far to the side."""
    T = [se3.exp(np.array([0.1 * i, 0.03 * i * i, 0.02 * i, 0.0, 0.03 * i, 0.0])) for i in range(6)]
    for i in (1, 3, 5):
        T[i][0, 3] += 30.0
    return np.stack(T)


class WallAhead(Source):
    """A wall in front of the camera, with true surface and path in another frame."""

    def __init__(self, known: bool = True) -> None:
        super().__init__("wall", CAMERA)
        self.known = known

    def __len__(self) -> int:
        return 6

    def frame(self, i: int) -> Frame:
        return Frame(i, float(i), np.full((72, 96, 3), 0.5, np.float32), np.full((72, 96), 2.0, np.float32), CAMERA)

    def truth(self) -> Trajectory:
        return Trajectory(np.arange(6.0), WORLD @ poses())

    def true_surface(self) -> Mesh | None:
        steps = np.linspace(-3, 3, 121)
        x, y = np.meshgrid(steps, steps, indexing="ij")
        n = np.arange(x.size).reshape(x.shape)
        quads = [n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]]
        faces = np.concatenate([np.stack([quads[i].ravel() for i in corners], 1) for corners in ((0, 1, 2), (0, 2, 3))])
        vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL_M)], 1)
        return Mesh(vertices.astype(np.float32), faces.astype(np.int32)).moved(WORLD) if self.known else None


class KnownView:
    """Renders the wall `off_m` too close, with low alpha on the left and too far away at the top; stores the poses."""

    def __init__(self, off_m: float = 0.0) -> None:
        self.off_m, self.seen = off_m, list[np.ndarray]()

    def __call__(self, field: GaussianField, camera: Camera, T_camera_world: np.ndarray) -> Any:
        assert camera == CAMERA.resized(48, 36)
        T = se3.inverse(T_camera_world)
        self.seen.append(T)
        ahead = camera.rays().astype(float) @ T[:3, :3].T[:, 2]
        alpha = np.full((36, 48), 0.95, np.float32)
        alpha[:, :12] = 0.5
        depth = (WALL_M - self.off_m - T[2, 3]) / ahead
        depth[:6] = 4.5
        color = np.full((36, 48, 3), 0.4)
        maps = {"depth": depth * alpha, "alpha": alpha, "color": color * alpha[..., None], "variance": 0 * color}
        return SimpleNamespace(**{name: torch.tensor(values, dtype=torch.float32) for name, values in maps.items()})


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder.create(tmp_path / "run", CONFIG, "wall")
    for i in range(6):
        run.log({"index": i, "timestamp_s": float(i), "is_keyframe": i in KEYFRAMES, "lost": False, "seconds": {}})
    run.write_trajectory(Trajectory(np.arange(6.0), poses()))
    run.write_map(GaussianField(torch.ones(3, 17)))
    write_checkpoint(run, KEYFRAMES)
    return run


def write_checkpoint(run: RunFolder, keyframes: list[int], **more: torch.Tensor) -> None:
    tensors = {"timestamps_s": torch.arange(6.0).double(), "T_world_camera": torch.from_numpy(poses()), **more}
    run.write_checkpoint(tensors | {"keyframes": torch.tensor(keyframes, dtype=torch.int64)}, {})


def test_the_surface_is_where_keyframes_render_it(run: RunFolder) -> None:
    renderer, told = KnownView(), list[tuple[int, int]]()
    mesh = FusionInput.of(run, CAMERA).surface(voxel_m=VOXEL_M, renderer=renderer, progress=lambda *at: told.append(at))
    np.testing.assert_allclose(renderer.seen, poses()[KEYFRAMES], atol=1e-12)
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert len(mesh.vertices) > 200 and np.abs(mesh.vertices[:, 2] - WALL_M).max() < 0.1 * VOXEL_M, "depth is D / A"
    np.testing.assert_allclose(mesh.colors, 0.4, atol=1e-5)
    # Low alpha on the left and depth beyond max_depth_m at the top give no surface. So the first camera limits the
    # surface: its left edge in x, its sixth row from the top in y.
    camera = CAMERA.resized(48, 36)
    assert mesh.vertices[:, 0].min() > (11 - camera.cx) / camera.fx * WALL_M - VOXEL_M
    assert mesh.vertices[:, 1].min() > (5 - camera.cy) / camera.fy * WALL_M - VOXEL_M


def submap_of(index: int, T_world_submap: np.ndarray, frames: tuple[int, ...]) -> tuple[Submap, list[Picture]]:
    """Make a submap of keyframes of the run, with `index` + 1 splats."""
    camera, T = CAMERA.resized(48, 36), np.array([se3.inverse(T_world_submap) @ poses()[i] for i in frames])
    picture = Picture(np.zeros((36, 48, 3), np.uint8), np.zeros((36, 48), np.float32))
    return Submap(index, GaussianField(torch.ones(index + 1, 17)), frames, T, camera), [picture] * len(frames)


def test_each_keyframe_renders_its_own_submap(run: RunFolder) -> None:
    """Rendered in the submap's frame and placed by its anchor, the surface is that of the run without submaps."""
    whole = FusionInput.of(run, CAMERA).surface(voxel_m=VOXEL_M, renderer=KnownView())
    anchors = [np.eye(4), se3.exp(np.array([0.3, -0.1, 0.2, 0.1, 0.4, 0.0]))]
    for index, frames in enumerate(((0, 2), (4,))):
        run.submaps.save(*submap_of(index, anchors[index], frames))
    show, seen, told = KnownView(), list[tuple[int, np.ndarray]](), list[tuple[int, int]]()

    def renderer(field: GaussianField, camera: Camera, T_camera_submap: np.ndarray) -> Any:
        seen.append((len(field), T_camera_submap))
        return show(field, camera, T_camera_submap @ se3.inverse(anchors[len(field) - 1]))

    with pytest.raises(RunError, match="has 2 submaps, but its checkpoint has poses of 0; run it again"):
        FusionInput.of(run, CAMERA).surface(renderer=renderer)
    write_checkpoint(run, KEYFRAMES, T_world_submap=torch.from_numpy(np.stack(anchors)))
    (run.path / "map.ply").unlink()  # it must not be needed
    mesh = FusionInput.of(run, CAMERA).surface(voxel_m=VOXEL_M, renderer=renderer, progress=lambda *at: told.append(at))
    assert [splats for splats, _ in seen] == [1, 1, 2] and told == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_allclose(seen[2][1], se3.inverse(poses()[4]) @ anchors[1], atol=1e-9)
    np.testing.assert_allclose(mesh.vertices, whole.vertices, atol=1e-4)
    np.testing.assert_array_equal(mesh.faces, whole.faces)


def test_evaluation_scores_the_mesh_in_the_truths_frame(run: RunFolder) -> None:
    metrics = evaluate(run, WallAhead(), renderer=KnownView(off_m=0.005), strips_per_kind=0, mesh=True, random_views=0)
    found = metrics["reconstruction"]
    assert found["accuracy_m"] == pytest.approx(0.005, rel=0.05) and found["precision"] > 0.999
    assert 0.5 < found["recall"] < found["completion_ratio"] < 0.9, (
        "the map has low alpha on the left and is too far away at the top"
    )
    assert run.read_metrics()["reconstruction"].items() >= {n: v for n, v in found.items() if np.isfinite(v)}.items()
    page = (run.path / "report.html").read_text()
    assert "F1 (1 cm), %" in page and "Completion ratio (&lt; 5 cm), %" in page
    off = read_mesh(run.path / "mesh.ply").vertices[:, 2] - (WALL_M - 0.005)
    assert np.abs(off).max() < 0.004 and np.median(np.abs(off)) < 1e-5, "in the world of the run"


def test_evaluation_scores_the_splats_in_the_truths_frame(run: RunFolder) -> None:
    params = torch.ones(3, 17)
    params[:, :3] = torch.tensor([[0.0, 0.0, 1.7], [0.3, 0.1, WALL_M], [1.0, 1.0, 9.0]])
    run.write_map(GaussianField(params))
    found = evaluate(run, WallAhead(), renderer=KnownView(), strips_per_kind=0, mesh=True, random_views=0)[
        "reconstruction"
    ]
    assert found["splats_accuracy_m"] == pytest.approx(0.15, rel=1e-4), "the third one is hidden"
    assert found["floaters"] == pytest.approx(2 / 3)
    assert found["splats_chamfer_m"] == pytest.approx((0.15 + found["splats_completion_m"]) / 2, rel=1e-4)
    page = (run.path / "report.html").read_text()
    assert "66.67" in page and "15.00" in page


def test_a_given_mesh_is_the_true_surface(run: RunFolder) -> None:
    """A wall of two faces, 1 cm behind the one that the source knows."""
    corners = np.array([[-3, -3, WALL_M + 0.01], [3, -3, WALL_M + 0.01], [3, 3, WALL_M + 0.01], [-3, 3, WALL_M + 0.01]])
    given = Mesh(corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)).moved(WORLD)
    metrics = evaluate(
        run, WallAhead(), renderer=KnownView(), strips_per_kind=0, mesh=True, true_mesh=given, random_views=0
    )
    assert metrics["reconstruction"]["accuracy_m"] == pytest.approx(0.01, rel=0.05)
    published = metrics["reconstruction_published"]
    assert published["completion_ratio"] == pytest.approx(metrics["reconstruction"]["completion_ratio"], abs=0.02)
    assert "Surface, by the protocol of published systems" in (run.path / "report.html").read_text()


def test_without_a_true_surface_the_mesh_has_no_score(run: RunFolder) -> None:
    metrics = evaluate(run, WallAhead(known=False), renderer=KnownView(), strips_per_kind=0, mesh=True, random_views=0)
    assert metrics["reconstruction"] is None and (run.path / "mesh.ply").exists()
    (run.path / "mesh.ply").unlink()
    metrics = evaluate(run, WallAhead(), renderer=KnownView(), strips_per_kind=0)
    assert metrics["reconstruction"] is None and not (run.path / "mesh.ply").exists(), "only on request"
    assert "Surface" not in (run.path / "report.html").read_text()


def test_no_keyframes_and_zero_voxels_are_refused(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match="a voxel must be above 0"):
        FusionInput.of(run, CAMERA).surface(voxel_m=0.0, renderer=KnownView())
    write_checkpoint(run, [])
    with pytest.raises(RunError, match="no keyframes in its checkpoint"):
        FusionInput.of(run, CAMERA).surface(renderer=KnownView())
    (run.path / "checkpoint.safetensors").unlink()
    with pytest.raises(RunError, match=r"no checkpoint\.safetensors"):
        FusionInput.of(run, CAMERA).surface(renderer=KnownView())


def test_the_working_camera_is_that_of_prepared_frames(run: RunFolder) -> None:
    frame = WallAhead().frame(0).prepared(48, 0.1, 4.0)
    assert FusionInput.of(run, CAMERA).camera == frame.camera


def test_a_cropped_run_has_the_cropped_camera(run: RunFolder) -> None:
    write_json(run.path / "config.json", replace(CONFIG, input=replace(CONFIG.input, crop_px=3)).to_dict())
    frame = WallAhead().frame(0).prepared(48, 0.1, 4.0, 3)
    assert FusionInput.of(run, CAMERA).camera == frame.camera and frame.camera.width == 42


def test_the_command_makes_a_mesh_of_a_real_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xatlas", reason="no wheel of xatlas for this machine")
    monkeypatch.setattr("sigmasplat.plugins.outputs.mesh_texture.SIZES", (256, 256))
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    room, out = "synthetic:frames=120,width=64,height=48", str(tmp_path / "run")
    small = ["--set", "mapping.first_iterations=30", "--set", "mapping.iterations=8", "--set", "input.width=64",
             "--set", "final.iterations=40"]  # fmt: skip
    assert exit_code("run", room, "--limit", "6", "--no-eval", "--out", out, *small) == 0
    capsys.readouterr()
    assert exit_code("mesh", out, "--voxel-m", "0.05") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "surface …" and re.match(r"surface (\d+)/\1\b", said[1])
    assert said[-1].endswith(f"triangles: {out}/mesh.ply")
    first, mesh = (tmp_path / "run" / "mesh.ply").read_bytes(), read_mesh(tmp_path / "run" / "mesh.ply")
    source = open_source(room)
    off = distances(mesh.moved(source.truth().T_world_camera[0]).vertices.astype(float), source.true_surface())
    assert len(mesh.faces) > 1000 and np.median(off) < 0.03
    assert exit_code("mesh", out, "--voxel-m", "0.05") == 0, "the run's own mesh is replaced"
    assert (tmp_path / "run" / "mesh.ply").read_bytes() == first, "and the same"
    budget = ["--voxel-m", "0.05", "--triangles", "500"]
    assert exit_code("mesh", out, *budget, "--out", str(tmp_path / "z.ply"), "--axes", "z-up") == 0
    assert exit_code("mesh", out, *budget, "--out", str(tmp_path / "y.stl")) == 0
    z_up, y_up = read_mesh(tmp_path / "z.ply"), trimesh.load(tmp_path / "y.stl", process=False)
    assert 250 < len(z_up.faces) <= 500 and len(y_up.faces) == len(z_up.faces)
    np.testing.assert_allclose(y_up.triangles, z_up.corners[..., [0, 2, 1]] * [1, 1, -1], atol=1e-5)
    np.testing.assert_allclose(np.sqrt(z_up.areas().sum() / mesh.areas().sum()), 1.0, atol=0.1, err_msg="still metres")
    for name in ("t.glb", "t.usdz"):
        assert exit_code("mesh", out, *budget, "--out", str(tmp_path / name)) == 0
    (shown,) = trimesh.load_scene(tmp_path / "t.glb", process=False).geometry.values()
    assert shown.visual.material.baseColorTexture.size == (256, 256) and len(shown.faces) == len(z_up.faces)
    for refused, words in (
        (["--out", str(tmp_path / "a.fbx")], "give a name that ends in .ply, .glb, .stl"),
        (["--out", str(tmp_path / "a.glb"), "--axes", "z-up"], "a GLB has y up by definition"),
        (["--out", str(tmp_path / "a.usdz"), "--no-texture"], "a USDZ has a texture"),
        (["--triangles", "-1"], "--triangles must be at least 0"),
        (["--out", str(tmp_path / "run" / "mesh.ply")], "exists; give another --out"),
        (["--voxel-m", "-1"], "--voxel-m must be above 0"),
    ):
        capsys.readouterr()
        assert exit_code("mesh", out, *refused) == 2
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 and words in said[0]


def test_the_triangles_of_the_room_match_its_depth() -> None:
    """Every depth of a noiseless frame is on the true surface, and no part of the surface is in front of it."""
    from sigmasplat.data.mesh import mesh_depth

    room = SyntheticRoom(frames=40, width=96, height=72, seed=1)
    surface = room.true_surface()
    edges = np.linalg.norm(surface.corners - np.roll(surface.corners, 1, axis=1), axis=2)
    assert edges.max() < 0.08 and surface.areas().min() > 0
    for i in (0, 13, 27):
        frame, T = room.frame(i), room.truth().T_world_camera[i]
        points = (frame.camera.rays() * frame.depth_m[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        assert np.quantile(distances(points, surface), 0.999) < 1e-3
        depth_m, _ = mesh_depth(surface, room.camera, se3.inverse(T))
        assert (np.abs(depth_m - frame.depth_m) < 5e-3).mean() > 0.998
    assert (
        open_source("synthetic:frames=40,width=96,height=72,seed=1", stride=2).true_surface().faces.shape
        == surface.faces.shape
    )


@pytest.mark.parametrize("kind", ["box", "ball", "drum"])
def test_the_shapes_of_the_room_are_closed_and_face_outwards(kind: str) -> None:
    from sigmasplat.plugins.sources.room.furnish import furnish_rooms
    from sigmasplat.plugins.sources.room.shapes import triangulate

    shape = next(s for s in furnish_rooms(1, 0)[0] if s.kind == kind)
    a, b, c = np.moveaxis(triangulate([shape]).corners - shape.center, 1, 0)
    per_half = {"box": 8.0, "ball": 4 / 3 * np.pi, "drum": 2 * np.pi}
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(per_half[kind] * float(np.prod(shape.half)), rel=0.01)
