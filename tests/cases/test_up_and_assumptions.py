"""Handed cases 12 and 15, and what a run says of values that its recording does not hold."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from sigmasplat.input.opening import open_source

QUICK = ("--set", "final.iterations=0")
CASES = Path(__file__).parents[3] / "shared" / "cases"


def case(name: str, tmp_path: Path) -> Path:
    """Return a copy of a handed input; skip the test where the inputs are absent."""
    if not (CASES / name).is_dir():
        pytest.skip(f"the handed case {name} is not there")
    return Path(shutil.copytree(CASES / name / "rec", tmp_path / "rec"))


def small_folder(tmp_path: Path, **calibration: object) -> Path:
    """Write a plain folder of two frames of 32×24 pixels, and a calibration if there is one."""
    folder = tmp_path / "plain"
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True)
    colors = np.random.default_rng(0).integers(0, 255, (2, 24, 32, 3), np.uint8)
    for n, color in enumerate(colors):
        Image.fromarray(color).save(folder / f"color/{n:06d}.png")
        Image.fromarray(np.full((24, 32), 1500 + n, np.uint16)).save(folder / f"depth/{n:06d}.png")
    if calibration:
        (folder / "calibration.json").write_text(json.dumps(calibration))
    return folder


def assumed(folder: Path, **settings: object) -> str:
    return "\n".join(open_source(folder, **settings).assumptions)


def test_each_value_that_is_not_recorded_is_said_with_what_changes_it(tmp_path: Path) -> None:
    folder = small_folder(tmp_path)
    said = assumed(folder, fx=30.0)
    for words in ("depth unit: 1000 per metre", "--depth-scale", "image centre: the middle", "--cx PX --cy PX",
                  "lens: no distortion", "depth and colour: one camera"):  # fmt: skip
        assert words in said, words
    given = open_source(folder, fx=30.0, cx=15.0, cy=12.0, depth_scale=2000.0)
    assert "depth unit" not in "\n".join(given.assumptions) and "centre" not in "\n".join(given.assumptions)
    assert given.origins["depth unit"].origin == given.origins["camera"].origin == "given"


def test_what_a_file_holds_is_read_from_it_and_not_assumed(tmp_path: Path) -> None:
    camera = {"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "width": 32, "height": 24}
    folder = small_folder(tmp_path, **camera, depth_scale=1000, distortion=[0.01, 0, 0, 0, 0])
    source = open_source(folder)
    for name in ("camera", "depth unit"):
        assert source.origins[name].origin == f"read from {folder / 'calibration.json'}"
    assert not any(line.startswith(("lens", "depth unit", "size", "camera")) for line in source.assumptions)


def test_a_calibration_without_a_size_is_said_to_be_that_of_the_images(tmp_path: Path) -> None:
    folder = small_folder(tmp_path, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
    assert "size of the calibration: that of the images (width and height in" in assumed(folder)


def test_a_partial_calibration_changes_only_what_it_names(tmp_path: Path) -> None:
    folder = small_folder(tmp_path)
    matrix = [30.0, 0, 0, 0, 31.0, 0, 15.0, 12.0, 1]
    (folder / "intrinsic.json").write_text(json.dumps({"width": 32, "height": 24, "intrinsic_matrix": matrix}))
    (folder / "calibration.json").write_text('{"depth_scale": 500}')
    source = open_source(folder)
    assert (source.camera.fx, source.camera.fy, source.depth_units_per_metre) == (30.0, 31.0, 500.0)
    assert source.origins["camera"].origin.endswith("intrinsic.json")
    assert source.origins["depth unit"].origin.endswith("calibration.json")


def test_a_run_prints_and_keeps_its_assumptions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    recording = case("03-tum-lists-mm", tmp_path)
    assert exit_code("run", str(recording), "--limit", "2", "--no-eval", *QUICK, "--out", str(out)) == 0
    printed = capsys.readouterr().out
    assert "assumed, because the recording does not say it" in printed
    assert "depth unit: 5000 per metre" in printed and "--depth-scale 1000, if in mm" in printed
    kept = json.loads((out / "run.json").read_text())["origins"]["depth unit"]
    assert kept["origin"] == "assumed" and kept["option"] == "--depth-scale 1000, if in mm"


def test_a_camera_that_was_held_sideways_is_said_and_turned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    out = tmp_path / "run"
    recording = case("15-sideways-camera", tmp_path)
    assert exit_code("run", str(recording), "--limit", "4", "--no-eval", *QUICK, "--out", str(out)) == 0
    up = {}
    for edge in ("auto", "left", "right"):
        assert exit_code("export", str(out), "--out", str(tmp_path / f"{edge}.ply"), "--up", edge) == 0
        up[edge] = capsys.readouterr().out
    assert (
        "up is the top of the images, if the camera was held upright: --up left, right or bottom turn it" in up["auto"]
    )
    assert "up is the left of the images" in up["left"] and "up is the right of the images" in up["right"]


def test_what_is_corrected_is_said_too(tmp_path: Path) -> None:
    folder = small_folder(tmp_path)
    for path in folder.glob("color/*.png"):
        exif = Image.Exif()
        exif[0x0112] = 3
        Image.open(path).save(path, exif=exif)
    source = open_source(folder, fx=30.0)
    assert source.corrections == ["orientation: turned by the EXIF tag of the images (180°)"]
    assert not open_source(small_folder(tmp_path / "b"), fx=30.0).corrections
