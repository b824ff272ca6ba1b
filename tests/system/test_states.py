"""Frames that are lost: what a run with the real SLAM leaves, and what reads it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from sigmasplat.config import Config, TrackingConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.run.session import Outcome, Session
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES, COVERED = 9, (4, 5)


class CoveredCamera(SyntheticRoom):
    """The first frames of the room; the camera is covered for two frames."""

    def __init__(self) -> None:
        super().__init__(frames=120, width=64, height=48)

    def __len__(self) -> int:
        return FRAMES

    def truth(self) -> Trajectory:
        return SyntheticRoom(frames=120, width=64, height=48).truth()

    def frame(self, i: int) -> Frame:
        frame = super().frame(i)
        if i not in COVERED:
            return frame
        return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def config() -> Config:
    quick = {"input.width": "64", "mapping.first_iterations": "30", "mapping.iterations": "10", "final.iterations": "2"}
    return override(preset(default_preset()), quick)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, Outcome]:
    run = RunFolder.create(tmp_path_factory.mktemp("states") / "run", config(), "room")
    session = Session(Slam(config(), run.submaps), CoveredCamera(), run)
    return run, session.execute()


def test_lost_frames_have_a_state_but_no_pose(result: tuple[RunFolder, Outcome]) -> None:
    run, outcome = result
    frames, log = run.read_frames(), run.read_log()
    assert outcome.lost == 2 == len(frames.indices("lost")) and outcome.frames == FRAMES == len(log)
    assert tuple(frames.indices("lost")) == COVERED and outcome.apart == ()
    assert all(record["lost"] == (record["state"] == "lost") for record in log)
    assert all(0.0 <= record["p_off"] <= 1.0 for record in log)
    kept = [i for i in range(FRAMES) if i not in COVERED]
    assert frames.rows.tolist() == kept
    whole = run.read_checkpoint()[0]["T_world_camera"].numpy()
    np.testing.assert_allclose(run.read_trajectory().T_world_camera, whole[kept], atol=1e-9)


def test_lost_frames_are_not_scored_and_not_exported(
    result: tuple[RunFolder, Outcome], capsys: pytest.CaptureFixture[str]
) -> None:
    run, _ = result
    metrics = evaluate(run, CoveredCamera(), views_per_kind=20, strips_per_kind=1)
    assert (metrics["frames"], metrics["believed"], metrics["lost"]) == (FRAMES, FRAMES - 2, 2)
    assert metrics["ate"]["pairs"] == FRAMES - 2 and metrics["failures"]["silent"] == 0
    assert metrics["training"]["views"] + metrics["held_out"]["views"] == FRAMES - 2
    assert "States of the frames" in (run.path / "report.html").read_text()
    out: Path = run.path.parent / "path.txt"
    assert exit_code("export", str(run.path), "--out", str(out)) == 0
    assert len(read_poses(out)) == FRAMES - 2 and "left out: 2 lost" in capsys.readouterr().out


@pytest.mark.parametrize(("least_share", "state"), [(0.2, "tracked"), (0.9, "lost")])
def test_a_frame_that_shares_too_little_is_lost(
    monkeypatch: pytest.MonkeyPatch, least_share: float, state: str
) -> None:
    monkeypatch.setattr(TrackingConfig, "lost_share", least_share)
    little = {"mapping.first_iterations": "5", "final.iterations": "0", "recovery.relocalise": "false"}
    room, slam = SyntheticRoom(frames=120, width=160, height=120), Slam(override(preset("sigma"), little))
    slam.step(room.frame(0))
    step = slam.step(replace(room.frame(5), index=1))
    assert 0.2 < step.tracking["common"] < 0.9 and step.state == state
