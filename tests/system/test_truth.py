"""A run neither reads ground truth nor depends on it. Only the evaluation reads it."""

from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from sigmasplat import cli
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.run.session import Session
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from tum_recording import write_tum

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SETTINGS = {"input.width": "64", "mapping.first_iterations": "10", "mapping.iterations": "4", "final.iterations": "10"}
FRAMES = 7
OPTIONS = [word for pair in SETTINGS.items() for word in ("--set", "=".join(pair))]
LEFT = ("trajectory.txt", "map.ply", "checkpoint.safetensors")


class TruthWasRead(Exception):
    """The ground truth was read."""


class SourceWithoutTruth(Source):
    """The first frames of a room; reading its ground truth raises unless a truth is given."""

    def __init__(self, truth: Trajectory | None = None) -> None:
        self._room, self._truth = SyntheticRoom(frames=120, width=64, height=48), truth
        super().__init__("room", self._room.camera)

    def __len__(self) -> int:
        return FRAMES

    def frame(self, i: int) -> Frame:
        return self._room.frame(self._checked_index(i))

    def truth(self) -> Trajectory | None:
        if self._truth is None:
            raise TruthWasRead
        return self._truth

    def true_surface(self) -> Mesh | None:
        raise TruthWasRead


def config() -> Config:
    return override(preset(default_preset()), SETTINGS)


def test_slam_and_session_never_read_the_truth(tmp_path: Path) -> None:
    source, run = SourceWithoutTruth(), RunFolder.create(tmp_path / "run", config(), "room")
    outcome = Session(Slam(config()), source, run).execute()
    assert (outcome.status, outcome.frames, outcome.lost) == ("complete", FRAMES, 0)
    assert len(run.read_trajectory()) == FRAMES


def test_the_command_line_reads_the_truth_only_to_evaluate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("sigmasplat.plugins.sources", "sigmasplat.run.scene"):
        monkeypatch.setattr(f"{place}.open_source", lambda path, settings=None: SourceWithoutTruth())
    assert exit_code("run", "room", "--out", str(tmp_path / "run"), "--no-eval", *OPTIONS) == 0
    assert exit_code("mesh", str(tmp_path / "run"), "--voxel-m", "0.1") == 0
    with pytest.raises(TruthWasRead):
        cli.main(["eval", str(tmp_path / "run")])


def tum_folder(folder: Path, kind: str) -> Path:
    """Write the same frames with the true path, with another path, or with none."""
    whole = SyntheticRoom(frames=120, width=64, height=48).truth()
    poses = whole.T_world_camera[:FRAMES]
    if kind == "another":
        poses = np.array([se3.exp(np.random.default_rng(i).normal(size=6)) for i in range(FRAMES)])
    write_tum(SourceWithoutTruth(Trajectory(whole.timestamps_s[:FRAMES], poses)), folder)
    if kind == "none":
        (folder / "groundtruth.txt").unlink()
    return folder


def test_the_truth_does_not_change_the_bytes_of_a_run(tmp_path: Path) -> None:
    found, errors_m = {}, {}
    for kind in ("true", "another", "none"):
        out, folder = tmp_path / "runs" / kind, tum_folder(tmp_path / kind, kind)
        evaluated = () if kind == "another" else ("--no-eval",)
        assert exit_code("run", str(folder), "--out", str(out), *evaluated, *OPTIONS) == 0
        found[kind] = [(out / name).read_bytes() for name in LEFT]
        truth = open_source(folder).truth()
        errors_m[kind] = truth and ate(RunFolder.open(out).read_trajectory(), truth).rmse_m
    assert found["true"] == found["another"] == found["none"]
    assert errors_m["none"] is None and errors_m["true"] < 0.05 < errors_m["another"]
    scored = RunFolder.open(tmp_path / "runs" / "another").read_metrics()["ate"]
    assert scored["rmse_m"] == pytest.approx(errors_m["another"])
