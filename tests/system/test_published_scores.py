"""Scores of published systems on the layouts of their data sets, made from the synthetic room, by the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from command_line import exit_code
from layouts import Sample, opengl, rows, save, save_text, transforms
from lpips_weights import write_weights
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.input.source import Source
from sigmasplat.plugins.outputs.mesh_files import write_mesh
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 8
SETTINGS = {"input.width": "64", "mapping.first_iterations": "30", "mapping.iterations": "4", "final.iterations": "10"}
OPTIONS = [word for pair in SETTINGS.items() for word in ("--set", "=".join(pair))]


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    return SyntheticRoom(frames=120, width=96, height=72, test_views=3)


def walls(room: SyntheticRoom) -> Mesh:
    """Return the box around the true surface, 12 large faces, without the furniture."""
    surface = room.true_surface()
    box = trimesh.creation.box(bounds=[surface.vertices.min(0), surface.vertices.max(0)])
    return Mesh(box.vertices.astype(np.float32), box.faces.astype(np.int32))


def sample(source: Source, poses: np.ndarray, count: int) -> Sample:
    """Return frames as the images that data sets store."""
    frames: list[Frame] = [source.frame(i) for i in range(count)]
    color = np.stack([np.rint(255 * frame.color).astype(np.uint8) for frame in frames])
    return Sample(color, np.stack([np.rint(1000 * frame.depth_m).astype(np.uint16) for frame in frames]), poses[:count])


def scored(folder: Path, run: Path, *options: str) -> dict[str, object]:
    assert exit_code("run", str(folder), "--out", str(run), "--no-eval", *OPTIONS) == 0
    assert exit_code("eval", str(run), *options) == 0
    return RunFolder.open(run).read_metrics()


@pytest.mark.slow
def test_replicas_layout_has_all_scores_of_the_papers(
    room: SyntheticRoom, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # weights in data/lpips would be found
    s = sample(room, room.truth().T_world_camera, FRAMES)
    folder, c = tmp_path / "room0", room.camera
    for n in range(FRAMES):
        save(folder / f"results/frame{n:06d}.jpg", s.color[n], quality=100, subsampling=0)
        save(folder / f"results/depth{n:06d}.png", s.depth_mm[n])
    save_text(folder / "traj.txt", "".join(rows(T).replace("\n", " ").strip() + "\n" for T in s.T_world_camera))
    camera = {"w": c.width, "h": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 1000.0}
    save_text(tmp_path / "cam_params.json", json.dumps({"camera": camera}))
    write_mesh(tmp_path / "room0_mesh.ply", walls(room))
    write_weights(tmp_path / "weights")

    extra = ("--mesh", "--full-resolution", "--random-views", "6", "--lpips", str(tmp_path / "weights"))
    metrics = scored(folder, tmp_path / "run", *extra)
    published = metrics["reconstruction_published"]
    assert published["chamfer_m"] == pytest.approx((published["accuracy_m"] + published["completion_m"]) / 2)
    assert 0 < published["f1"] <= 1 and 0 < published["completion_ratio"] <= 1
    assert published.keys() >= {"precision", "recall", "depth_l1_m", "depth_views"}
    assert metrics["full_resolution"]["width"] == 96 and metrics["full_resolution"]["training"]["lpips"] > 0
    assert metrics["training"]["lpips"] > 0 and metrics["ate_keyframes"]["rmse_m"] < 0.1
    assert "LPIPS" not in capsys.readouterr().out

    assert exit_code("eval", str(tmp_path / "run")) == 0
    assert "no alex.pth in" in capsys.readouterr().out
    without = RunFolder.open(tmp_path / "run").read_metrics()
    assert without["reconstruction"] is without["full_resolution"] is without["training"]["lpips"] is None
    assert exit_code("eval", str(tmp_path / "run"), "--true-mesh", str(tmp_path / "nothing.ply")) == 2
    assert exit_code("eval", str(tmp_path / "run"), "--lpips", str(tmp_path)) == 2


@pytest.mark.slow
def test_test_views_of_scannetpp_are_scored_apart_from_training_views(room: SyntheticRoom, tmp_path: Path) -> None:
    dslr = tmp_path / "0a5c013435" / "dslr"
    away = room.test_views()
    parts = {"frames": (room, room.truth(), FRAMES), "test_frames": (away, away.truth(), len(away))}
    listed = dict[str, list[dict[str, object]]]()
    for key, (source, path, count) in parts.items():
        s, listed[key] = sample(source, path.T_world_camera, count), []
        for n in range(count):
            name = f"{key}{n:05d}"
            save(dslr / f"undistorted_images/{name}.JPG", s.color[n], quality=100, subsampling=0)
            save(dslr / f"undistorted_depths/{name}.png", s.depth_mm[n])
            pose = opengl(s.T_world_camera[n])
            listed[key].append({"file_path": f"{name}.JPG", "transform_matrix": pose, "is_bad": False})
    text = transforms(room.camera, listed["frames"], test_frames=listed["test_frames"], camera_model="PINHOLE")
    save_text(dslr / "nerfstudio/transforms_undistorted.json", text)

    metrics = scored(dslr.parent, tmp_path / "run", "--full-resolution")
    assert metrics["frames"] == FRAMES and metrics["test_views"]["views"] == 3
    assert np.isfinite(metrics["test_views"]["psnr_image_db"]) and metrics["training"]["views"] >= 1
    full = metrics["full_resolution"]["test_views"]
    assert full["views"] == 3 and full["psnr_image_db"] != metrics["test_views"]["psnr_image_db"]
