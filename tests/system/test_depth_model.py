"""A run whose depth a network predicts: the same as with a folder of its predictions, also after a resume."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from depth_networks import weighted
from paper_settings import InputConfig
from run_process import lines, wait_for
from sigmasplat.data.frame_arrays import color_from_bytes
from sigmasplat.plugins.predicted_depth.depth_model import DepthModel
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES, MOST_M = 16, 6.0
SETTINGS = {
    "input.width": "80", "input.depth_model_colors": "unit", "mapping.first_iterations": "8", "mapping.iterations": "4",
    "submaps.frames": "4", "final.iterations": "6",
}  # fmt: skip
SAME = ("trajectory.txt", "map.ply", "loops.json", "checkpoint.safetensors")


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write images of the room whose blue is its depth; a network that only scales blue then predicts depth."""
    folder, room = tmp_path_factory.mktemp("walk") / "photos", open_source("synthetic:frames=200,width=160,height=120")
    folder.mkdir()
    for i in range(FRAMES):
        frame = room.frame(i)
        color = np.dstack([frame.color[..., :2], frame.depth_m / MOST_M])
        Image.fromarray(np.rint(255.0 * color).astype(np.uint8)).save(folder / f"{i}.png")
    return folder


def blue(path: Path, most_m: float = MOST_M) -> str:
    return weighted(path, (1, 3, 96, 128), weights=(0.0, 0.0, most_m))


def arguments(photos: Path, out: Path, *depth: str) -> list[str]:
    settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    more = ["--fx", "130", "--out", str(out), "--no-eval", "--save-every", "0.001", *depth]
    return ["run", str(photos), *more, *settings]


@pytest.mark.slow
def test_a_network_gives_what_a_folder_of_its_predictions_gives_and_a_resume_needs_the_same(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "blue.onnx"
    model = DepthModel(Path(blue(path)), InputConfig(depth_model_colors="unit"))
    (tmp_path / "predicted").mkdir()
    for image in photos.iterdir():
        color = color_from_bytes(np.array(Image.open(image)))
        np.save(tmp_path / "predicted" / f"{image.stem}.npy", model.predict(color))
    assert exit_code(*arguments(photos, tmp_path / "folder", "--predicted-depth", str(tmp_path / "predicted"))) == 0

    run = RunFolder(tmp_path / "run")
    command = [sys.executable, "-m", "sigmasplat.cli", *arguments(photos, run.path, "--depth-model", str(path))]
    process = subprocess.Popen(command, env=os.environ, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_for(process, lambda: lines(run.path) >= FRAMES // 3)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert lines(run.path) < FRAMES, "killed before the last frame"
    assert run.facts()["depth_model"] == {"file": "blue.onnx", "sha256": model.sha256}
    assert run.config().input.depth_model == str(path) and run.config().tracking.fit_depth

    blue(path, 2.0 * MOST_M)
    capsys.readouterr()
    assert exit_code("resume", str(run.path), "--no-eval") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "was made with another depth model" in said and model.sha256[:12] in said
    blue(path)
    assert exit_code("resume", str(run.path), "--no-eval") == 0
    for name in SAME:
        assert (run.path / name).read_bytes() == (tmp_path / "folder" / name).read_bytes(), name
    assert not any(line["lost"] for line in run.read_log())

    assert exit_code("eval", str(run.path)) == 0
    blue(path, 2.0 * MOST_M)
    assert exit_code("eval", str(run.path)) == 2
    path.unlink()
    capsys.readouterr()
    assert exit_code("eval", str(run.path)) == 2
    assert "No such file" in capsys.readouterr().err


def test_a_network_predicts_in_real_time_too(photos: Path, tmp_path: Path) -> None:
    path = blue(tmp_path / "blue.onnx")
    assert exit_code(*arguments(photos, tmp_path / "run", "--depth-model", path), "--realtime") == 0
    facts = RunFolder(tmp_path / "run").facts()
    assert facts["status"] == "complete" and facts["realtime"] and facts["predicted_depth"]


@pytest.mark.parametrize("content", [b"", b"\x08\x08:\x04none", b"PK\x03\x04" * 100])
def test_another_file_ends_with_one_line_and_no_run(
    photos: Path, tmp_path: Path, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "n.onnx").write_bytes(content)
    assert exit_code(*arguments(photos, tmp_path / "run", "--depth-model", str(tmp_path / "n.onnx"))) == 2
    assert "not a usable ONNX file" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()
