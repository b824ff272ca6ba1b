"""A recording that begins with a covered lens: the remedy of the refusal works as printed."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from recorded_room import OPTIONS, write_images
from small_room import SMALL, frames

SHORT = [word for name, value in (SMALL | {"final.iterations": "0"}).items() for word in ("--set", f"{name}={value}")]


def test_a_map_starts_after_the_covered_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_images(tmp_path / "rec", frames(5))
    for n in range(2):
        Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(folder / f"color/{n:04d}.png")
        Image.fromarray(np.zeros((120, 160), np.uint16)).save(folder / f"depth/{n:04d}.png")
    given = ["run", str(folder), *OPTIONS, *SHORT, "--no-eval"]
    assert exit_code(*given, "--out", str(tmp_path / "a")) == 2
    assert "start at a later one: --start SECONDS" in capsys.readouterr().err
    assert exit_code(*given, "--out", str(tmp_path / "b"), "--start", "0.06") == 0
    assert "3 frames" in capsys.readouterr().out
