"""`sigmasplat export` of paths, images, films and plans: names, and the options that each format accepts."""

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from films import read_film
from room_run import FRAMES, LOST, PATH, made_run
from sigmasplat.run_folder.splat_ply import read_field


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder with a run, kitchen/."""
    made_run(tmp_path / "kitchen", submaps=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_name_selects_the_format_of_a_path(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("export", "kitchen", "--out", "a.txt") == 0
    valid = np.arange(FRAMES) != LOST
    np.testing.assert_allclose(np.loadtxt("a.txt")[:, 1:4], PATH.T_world_camera[valid, :3, 3], atol=1e-9)
    assert exit_code("export", "kitchen", "--format", "colmap", "--pictures") == 0
    assert len(list((here / "kitchen-colmap/images").iterdir())) == 3
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("a.txt: 5 poses; left out: 1 lost")
    assert said[1:] == ["pictures …", "pictures 3/3", "kitchen-colmap: 3 views with their pictures"]


def test_film_plan_and_map_are_written_with_their_progress(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    film = ("--out", "a.mp4", "--size", "64", "--fps", "4", "--seconds", "0.5", "--path", "orbit")
    assert exit_code("export", "kitchen", *film) == 0
    frames, _ = read_film(here / "a.mp4")
    assert [frame.shape for frame in frames] == [(48, 192, 3)] * 2
    assert exit_code("export", "kitchen", "--format", "plan", "--cell-m", "0.1") == 0
    assert json.loads((here / "kitchen.plan.json").read_text())["resolution_m"] == 0.1
    for name, axes in (("a", "y-up"), ("own", "camera")):
        assert exit_code("export", "kitchen", "--out", f"{name}.ply", "--axes", axes) == 0
    upright, own = (read_field(Path(f"{name}.ply")).means.numpy() for name in ("a", "own"))
    turn = np.linalg.lstsq(own, upright, rcond=None)[0]  # y up, z back: 180° about x if the first camera is level
    assert np.allclose(own @ turn, upright, atol=1e-4) and np.isclose(np.linalg.det(turn), 1.0, atol=1e-4)
    assert turn[1, 1] < -0.8
    said = capsys.readouterr().out
    assert "film …\n" in said and "floor plan …\n" in said
    assert "a.mp4: 2 images, 0.5 s" in said and "m² of free floor, also in kitchen.plan.json" in said


def test_options_of_other_formats_and_wrong_values_are_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "map.ply").write_bytes((here / "kitchen/map.ply").read_bytes())
    for arguments, words in (
        (
            ["kitchen", "--out", "a.mp4", "--cell-m", "0.1"],
            "--cell-m cannot be used with format video, only with plan",
        ),
        (["kitchen", "--out", "a.txt", "--pictures"], "only with colmap"),
        (["kitchen", "--out", "a.mp4", "--fps", "0"], "--fps must be between 1 and 120"),
        (["kitchen", "--format", "video", "--out", "a.avi"], "give a name that ends in .mp4"),
        (["kitchen", "--out", "missing/a.txt"], "choose a writable place"),
        (["map.ply", "--out", "a.png"], "can be exported only as another map"),
    ):
        assert exit_code("export", *arguments) == 2
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 and words in said[0], said
    assert sorted(path.name for path in here.iterdir()) == ["kitchen", "map.ply"]
