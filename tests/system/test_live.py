"""Runs on a live camera: Ctrl-C or unplugging ends them, and the recording can be read again."""

import signal
import sys
import threading
from pathlib import Path

import pytest

from command_line import exit_code
from fake_realsense import Device
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.realsense import WARM_UP_FRAMES
from sigmasplat.realtime.system import RealTime
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.slam.results import Step

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

QUICK = [
    word
    for setting in ("input.width=80", "mapping.first_iterations=5", "mapping.iterations=3", "final.iterations=5")
    for word in ("--set", setting)
]


WAITING = ("--set", "realtime.live=off")
"""A frame waits until the one before it is mapped."""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Device:
    made = Device()
    monkeypatch.setitem(sys.modules, "pyrealsense2", made.module())
    monkeypatch.chdir(tmp_path)
    return made


def test_ctrl_c_ends_the_frames_and_the_run_is_finished_and_scored(
    device: Device, capsys: pytest.CaptureFixture[str]
) -> None:
    device.missed_between = 1
    device.on_frame = lambda number: signal.raise_signal(signal.SIGINT) if number == 2 * (WARM_UP_FRAMES + 6) else None
    assert exit_code("run", "realsense", "--out", "run", "--stride", "1", *QUICK, *WAITING) == 0
    said = capsys.readouterr()
    assert "until Ctrl-C" in said.out and "were dropped because SLAM was slower" in said.out
    run = RunFolder.open(Path("run"))
    facts, log = run.facts(), run.read_log()
    assert facts["status"] == "complete" and facts["finish_s"] >= 0
    assert facts["source_path"] == str(Path("run/recording").resolve())
    recorded = open_source(facts["source_path"], run.config().input)
    assert 4 <= len(log) <= len(recorded) <= len(log) + 2  # at most two frames were read ahead
    assert [line["timestamp_s"] for line in log] == pytest.approx(
        [recorded.timestamp_s(i) for i in range(len(log))], abs=1e-6
    )
    metrics = run.read_metrics()
    assert metrics["frames"] == len(log) and metrics["ate"] is None and metrics["training"]["psnr_db"] > 5
    assert exit_code("eval", "run") == 0  # does not open a camera
    assert device.started == device.stopped == 1


def test_a_live_camera_is_tracked_in_real_time(
    device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """This camera is faster than tracking: frames are dropped and counted, those that are left are recorded."""
    read, track = threading.Semaphore(0), RealTime.step

    def on_frame(number: int) -> None:
        if number > WARM_UP_FRAMES:
            read.release()
        if number == WARM_UP_FRAMES + 40:
            signal.raise_signal(signal.SIGINT)

    def track_late(system: RealTime, frame: Frame) -> Step:
        for _ in range(4):
            read.acquire(timeout=0.5)  # no frame is read after Ctrl-C
        return track(system, frame)

    device.on_frame = on_frame
    monkeypatch.setattr(RealTime, "step", track_late)
    assert exit_code("run", "realsense", "--out", "run", "--no-eval", *QUICK) == 0
    run = RunFolder.open(Path("run"))
    facts, log = run.facts(), run.read_log()
    assert facts["status"] == "complete" and facts["realtime"] is True and facts["dropped"] > 0
    recorded = open_source(facts["source_path"], run.config().input)
    assert [line["timestamp_s"] for line in log] == pytest.approx(
        [recorded.timestamp_s(line["index"]) for line in log], abs=1e-6
    )
    assert len(run.read_checkpoint()[0]["frame_submap"]) == len(log)
    assert "dropped because tracking was late" in capsys.readouterr().err


def test_an_unplugged_camera_gives_one_line_and_a_valid_run(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.frames_until_unplugged = WARM_UP_FRAMES + 5
    assert exit_code("run", "realsense", "--out", "run", "--record", "seen", "--no-eval", *QUICK) == 0
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if "tracking was late" not in line]  # on a busy machine
    assert len(lines) == 1 and "no frame for 5 s" in lines[0]
    facts = RunFolder.open(Path("run")).facts()
    assert facts["status"] == "complete" and len(open_source("seen")) == 5


def test_a_missing_camera_gives_one_line_and_no_files(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.plugged_in = False
    assert exit_code("run", "realsense") == 2
    assert capsys.readouterr().err.startswith("sigmasplat: no RealSense camera provides 640×480")
    assert not Path("runs").exists()


def test_a_repeated_run_keeps_the_earlier_recording(device: Device) -> None:
    for count in (2, 3):
        more = ("--overwrite", "--no-eval", "--limit", str(count))
        assert exit_code("run", "realsense", "--out", "run", *more, *QUICK) == 0
    assert len(open_source("run/recording")) == 2 and len(open_source("run/recording-2")) == 3
