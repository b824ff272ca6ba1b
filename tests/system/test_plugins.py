"""Plug-ins of other people: an installed package of 30 lines, and one file given by --plugin."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from sigmasplat import api, registry
from sigmasplat.errors import ConfigError
from sigmasplat.registry import FILES, Mask, Preset, named, rows

PACKAGE = '''
"""A source, a mask, a depth filter, an output and a preset of somebody else."""

from pathlib import Path

import numpy as np
from sigmasplat.api import Config, DepthFilter, Frame, Mask, Output, Preset, SourceFormat, open_source, preset


def _upper_rows(frame: Frame) -> np.ndarray:
    ignored = np.zeros(frame.depth_m.shape, bool)
    ignored[:4] = True
    return ignored


def _count(source: object, target: Path) -> str:
    target.write_text(f"{len(source.reader().frames)} frames")
    return "a count"


PLUGIN = (
    SourceFormat(
        "shorthand", "room.short", lambda path: path.endswith(".short"),
        lambda path, settings: open_source(Path(path).read_text()),
    ),
    Mask("upper-rows", _upper_rows),
    DepthFilter("near", lambda frame: np.where(frame.depth_m < 3, frame.depth_m, np.float32(0))),
    Output("count", (".count",), "the number of frames", _count),
    Preset("quick", lambda: preset("sigma").changed(mapping={"iterations": 3}, final={"iterations": 0})),
)
'''


@pytest.fixture(autouse=True)
def forget_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FILES, "")
    registry.use_files([])


def installed(folder: Path) -> Path:
    """Install a package with the entry point by pip, as a user would; return the folder it is in."""
    wheel, info = folder / "somebody-1-py3-none-any.whl", "somebody-1.dist-info"
    with zipfile.ZipFile(wheel, "w") as packed:
        packed.writestr("somebody_elses.py", PACKAGE)
        packed.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: somebody\nVersion: 1\n")
        packed.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        packed.writestr(f"{info}/entry_points.txt", "[sigmasplat.plugins]\nsomebody = somebody_elses\n")
        packed.writestr(f"{info}/RECORD", "")
    target = folder / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", str(target)]
    subprocess.run([*command, str(wheel)], check=True)
    return target


EVERY = """
import json, sys
from sigmasplat.cli import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as left:
        if left.code:
            raise
"""


def sigmasplat(site: Path, *commands: list[str]) -> str:
    """Run commands one after the other in one process, which has the package; return what they print."""
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", EVERY, json.dumps(commands)], env=os.environ | {"PYTHONPATH": path}, text=True,
        capture_output=True, check=True,
    )  # fmt: skip
    return done.stdout


def test_a_package_adds_a_source_a_mask_a_depth_filter_an_output_and_a_preset(tmp_path: Path) -> None:
    assert len(PACKAGE.splitlines()) <= 35
    site, recording, run = installed(tmp_path), tmp_path / "room.short", tmp_path / "run"
    recording.write_text("synthetic:frames=4,width=64,height=48")
    filters = ["--set", "input.filters=upper-rows,near"]
    said = sigmasplat(
        site, ["run", str(recording), "--preset", "quick", *filters, "--no-eval", "--out", str(run)],
        ["export", str(run), "--out", str(tmp_path / "run.count")], ["export", "--help"],
    )  # fmt: skip
    config = json.loads((run / "config.json").read_text())
    assert config["name"] == "quick" and config["mapping"]["iterations"] == 3
    assert (run / "map.ply").stat().st_size > 1000
    assert (tmp_path / "run.count").read_text() == "4 frames"
    assert "count: the number of frames" in said


def test_a_file_given_by_plugin_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.py"
    file.write_text(PACKAGE.replace('"quick"', '"mine"'))
    out = str(tmp_path / "run")
    asked = ["run", "synthetic:frames=3,width=64,height=48", "--preset", "mine", "--no-eval", "--out", out]
    assert exit_code(*asked) == 2 and "no preset 'mine'" in capsys.readouterr().err
    assert exit_code(*asked, "--plugin", str(file), "--set", "input.filters=upper-rows") == 0
    assert (Path(out) / "map.ply").is_file()
    assert named((Mask,), "upper-rows") in rows(Mask) and "mine" in [row.name for row in rows(Preset)]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("PLUGIN = 1", "PLUGIN is 1"),
        ("x = 1", "PLUGIN is None"),
        ("PLUGIN = ()", "PLUGIN is ()"),
        ("import nothing_of_this_name", "No module named 'nothing_of_this_name'"),
        ("1 +", "SyntaxError"),
        (
            "from sigmasplat.api import Preset, Config\nPLUGIN = Preset('sigma', Config)",
            "there is a preset 'sigma' already",
        ),
    ],
)
def test_a_plugin_that_cannot_be_used_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, reason: str
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    assert exit_code("run", "synthetic:frames=2", f"--plugin={file}", "--out", str(tmp_path / "run")) == 2
    error = capsys.readouterr().err
    assert reason in error and str(file) in error and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_missing_files_and_unknown_filters_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("doctor", "--plugin", str(tmp_path / "no.py")) == 2
    assert "no such file" in capsys.readouterr().err
    assert exit_code("doctor", "--plugin") == 2
    assert "--plugin needs a file" in capsys.readouterr().err
    out = tmp_path / "run"
    assert exit_code("run", "synthetic:frames=2", "--set", "input.filters=neer", "--out", str(out)) == 2
    assert "no mask or depth filter 'neer'" in capsys.readouterr().err


def test_a_mask_of_another_shape_is_refused_and_a_depth_filter_changes_what_slam_sees() -> None:
    from sigmasplat.tracking.depth_filters import frame_filter

    frame = next(iter(api.open_source("synthetic:frames=1,width=32,height=24")))
    registry.rows.cache_clear()
    wrong, near = Mask("wrong", lambda frame: np.zeros((2, 2), bool)), api.DepthFilter("none", lambda f: f.depth_m * 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_added", lambda: (("here", wrong), ("here", near)))
        with pytest.raises(ConfigError, match=r"mask 'wrong' returned bool \(2, 2\); return bool \(24, 32\)"):
            frame_filter("wrong")(frame)
        assert not frame_filter("none")(frame).depth_m.any() and frame.depth_m.any()
        assert frame_filter("")(frame) is frame
    registry.rows.cache_clear()


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        ("None", "returned None; return float32 (48, 64)"),
        ("frame.depth_m * float('nan')", "returned NaN, infinite or negative depth; 0 = no reading"),
        ("-frame.depth_m", "returned NaN, infinite or negative depth; 0 = no reading"),
        ("frame.depth_m[1:]", "returned float32 (47, 64); return float32 (48, 64)"),
        ("frame.depth_m > 1", "returned bool (48, 64); return float32 (48, 64)"),
    ],
)
def test_depth_that_cannot_be_used_is_one_line_that_names_the_filter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], returned: str, says: str
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(f"from sigmasplat.api import DepthFilter\nPLUGIN = DepthFilter('mine', lambda frame: {returned})")
    asked = ["run", "synthetic:frames=2,width=64,height=48", "--no-eval", "--out", str(tmp_path / "run")]
    assert exit_code(*asked, "--plugin", str(file), "--set", "input.filters=mine") == 2
    error = capsys.readouterr().err
    assert f"depth filter 'mine' {says}" in error and error.count("sigmasplat: ") == 1 and "Traceback" not in error


def test_help_of_run_names_plugin(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("run", "--help") == 0 and "--plugin my.py" in capsys.readouterr().out


def test_every_name_of_the_api_is_there_and_no_other() -> None:
    assert [name for name in api.__all__ if getattr(api, name) is None] == [] and len(api.__all__) > 20
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = api.Nothing
