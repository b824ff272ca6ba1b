"""`run --log rerun`: the values of every frame as a recording of Rerun."""

import sys
from pathlib import Path

import pytest

from command_line import exit_code
from sigmasplat.files.json_files import to_json
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=60,width=64,height=48"
TINY = ("--set", "input.width=64", "--set", "mapping.first_iterations=3", "--set", "final.iterations=0")


class FakeStream:
    """A stream of rerun that notes what it gets, and writes its last line when it is closed."""

    made: "list[FakeStream]" = []  # noqa: RUF012 - one list for all

    def __init__(self, name: str) -> None:
        self.frame, self.scalars, self.path, self.open = -1, dict[tuple[int, str], float](), Path(), True
        FakeStream.made.append(self)

    def save(self, path: str) -> None:
        self.path = Path(path)

    def set_time(self, name: str, sequence: int | None = None, duration: float | None = None) -> None:
        self.frame = self.frame if sequence is None else sequence

    def log(self, name: str, value: object, static: bool = False) -> None:
        if isinstance(value, float):
            self.scalars[self.frame, name] = value

    def flush(self) -> None:
        pass

    def disconnect(self) -> None:
        self.open = False


class FakeRerun:
    """The part of rerun that is used; scalars are plain numbers."""

    RecordingStream = FakeStream
    Scalars = float
    ViewCoordinates = type("ViewCoordinates", (), {"RDF": None})

    @staticmethod
    def LineStrips3D(strips: list) -> None:
        assert len(strips) == 1

    @staticmethod
    def Transform3D(**given: object) -> None:
        assert set(given) == {"translation", "mat3x3"}


def run(out: Path, *more: str) -> RunFolder:
    assert exit_code("run", ROOM, "--limit", "5", "--no-eval", "--out", str(out), *TINY, *more) == 0
    return RunFolder(out)


def test_a_recording_has_the_values_of_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", FakeRerun)
    FakeStream.made.clear()
    found = run(tmp_path / "run", "--log", "rerun")
    (stream,) = FakeStream.made
    assert stream.path == found.logs / "steps.rrd" and not stream.open
    for line in found.read_log():
        shown = {name: to_json(value) for (frame, name), value in stream.scalars.items() if frame == line["index"]}
        assert shown["values/splats"] == line["splats"] and shown["values/is_keyframe"] == line["is_keyframe"]
        for group in ("tracking", "seconds"):
            assert {name: shown[f"values/{group}/{name}"] for name in line[group]} == line[group]
    again = run(tmp_path / "run", "--overwrite")
    assert not again.logs.exists()


def test_rerun_writes_a_recording(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra `logs`)")
    found = run(tmp_path / "run", "--log", "rerun")
    assert (found.logs / "steps.rrd").read_bytes()[:4].startswith(b"RR")


@pytest.mark.parametrize(("name", "says"), [("rerun", "sigmasplat[logs]"), ("tensorboard", "rerun")])
def test_mistakes_leave_nothing(
    name: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert exit_code("run", ROOM, "--out", str(tmp_path / "run"), "--log", name) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "run").exists()
