"""The command line end to end with a fake SLAM: files, output and exit codes, also of interrupted runs."""

import io
import itertools
import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

import sigmasplat.run.finished_map  # noqa: F401 - loaded with the real SLAM, which other tests of this process need
from command_line import exit_code
from lpips_weights import write_weights
from sigmasplat import cli
from sigmasplat.config import Config
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.readout import UNKNOWN_TIMES
from sigmasplat.data.submap import SubmapStore
from sigmasplat.data.trajectory import Component, Trajectory
from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.input.lists import read_poses
from sigmasplat.input.source import Source
from sigmasplat.plugins.outputs.mesh_files import write_mesh
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run.callbacks import ENDING
from sigmasplat.run.session import Session
from sigmasplat.run.terminal import Screen
from sigmasplat.run_folder.frames import noted_up
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.splat_ply import read_field
from sigmasplat.run_folder.submaps import DiskStore

CAMERA = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
METRICS = {"ate": {"rmse_m": 0.0123}, "held_out": {"psnr_db": 27.31}, "training": {"psnr_db": 31.25}, "splats": 2}


class Corridor(Source):
    """Six blank frames one second apart."""

    depth_m = 2.0

    def __init__(self) -> None:
        super().__init__("my corridor", CAMERA)
        self.broken: set[int] = set()

    def __len__(self) -> int:
        return 6

    def frame(self, i: int) -> Frame:
        if i in self.broken:
            raise SourceError(f"{i}.png is truncated")
        return Frame(
            i, float(i), np.full((6, 8, 3), 0.5, np.float32), np.full((6, 8), self.depth_m, np.float32), CAMERA
        )

    def truth(self) -> Trajectory | None:
        return None


@dataclass
class MadeUpLoop:
    """A tested pair of submaps, as of SLAM."""

    query: int
    database: int
    accepted: bool
    residual: float = 0.02149
    translation_m: float = 0.043

    def record(self) -> dict[str, Any]:
        return vars(self) | {"chi2": float("nan")}


@dataclass
class MadeUpStep:
    """A step, as of SLAM."""

    index: int
    timestamp_s: float
    T_world_camera: np.ndarray
    is_keyframe: bool
    lost: bool
    splats: int = 2
    submap: int = 0
    loops: tuple["MadeUpLoop", ...] = ()
    tracking: dict[str, float] = field(default_factory=lambda: {"loss": float("nan")})
    seconds: dict[str, float] = field(default_factory=lambda: {"total": 0.1})
    state: str = "tracked"
    component: int = 0
    diagnosis: str = "20% of the image supports the pose"
    p_off: float = 0.25


class MadeUpSlam:
    """Moves 10 cm per frame. `at`: functions to call at a frame or at a step of the final map; `lost`: frames without
    tracking; `tried`: loops tested at a frame or at the end; a new submap starts after `every` frames. `relocalised`:
    frames found again; `apart`: the component of each frame that is in another one, until `joined`."""

    at: dict[int | str, Callable[[], None]]
    lost: set[int]
    tried: dict[int | str, list[MadeUpLoop]]
    every: int
    relocalised: set[int]
    apart: dict[int, int]
    joined: set[int]
    latest: "MadeUpSlam"

    def __init__(self, config: Config, store: SubmapStore | None = None) -> None:
        self.config, self.store = config, store
        self.loops: list[MadeUpLoop] = []
        self.finished = 0
        self.uncertainty, self.refinement_steps, self.sensor_times = None, None, UNKNOWN_TIMES
        self.field = GaussianField.from_values(torch.rand(2, 3), torch.full((2,), 0.1), torch.rand(2, 3))
        self.steps: list[MadeUpStep] = []
        MadeUpSlam.latest = self

    def step(self, frame: Frame) -> MadeUpStep:
        self.at.get(frame.index, lambda: None)()
        T = np.eye(4)
        T[0, 3] = 0.1 * frame.index
        i, tried = frame.index, tuple(self.tried.get(frame.index, ()))
        self.loops += tried
        component = self.apart.get(i, 0)
        state = "lost" if i in self.lost else "relocalised" if i in self.relocalised else "tracked"
        step = MadeUpStep(
            i, frame.timestamp_s, T, i % 5 == 0, i in self.lost, submap=i // self.every, loops=tried,
            state="apart" if component and state != "lost" else state, component=component,
        )  # fmt: skip
        self.steps.append(step)
        return step

    def settle(self) -> None:
        pass

    def finish(self, progress: Callable[[int, int], None]) -> None:
        progress(0, 2)
        self.at.get("loops", lambda: None)()
        self.loops += self.tried.get("end", [])
        for done in (1, 2):
            progress(done, 2)
            self.at.get(f"finish {done}", lambda: None)()
        self.finished += 1
        self.field = GaussianField.from_values(torch.rand(3, 3), torch.full((3,), 0.1), torch.rand(3, 3))

    def trajectory(self) -> Trajectory:
        poses = np.array([step.T_world_camera for step in self.steps]).reshape(-1, 4, 4)
        return Trajectory(np.array([step.timestamp_s for step in self.steps]), poses)

    def valid(self) -> np.ndarray:
        worlds = {0, *self.joined}
        return np.array([not step.lost and step.component in worlds for step in self.steps])

    def components(self) -> list[Component]:
        numbers = np.array([-1 if step.lost else step.component for step in self.steps])
        outside = sorted({*numbers.tolist()} - {-1, 0, *self.joined})
        return [Component(number, self.field, self.trajectory().at(numbers == number)) for number in outside]

    def checkpoint(self) -> dict[str, torch.Tensor]:
        return {"field.params": self.field.params}


@pytest.fixture
def corridor(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Corridor:
    """Replace source, SLAM and evaluation by fakes, and work in an empty folder."""
    source = Corridor()
    # This line must be the first: it imports `resume` with the real SLAM. The fake has no state to save.
    monkeypatch.setattr("sigmasplat.run.resume.StateFile.save", lambda *ignored: None)
    module = ModuleType("sigmasplat.system.slam")
    module.Slam = MadeUpSlam  # type: ignore[attr-defined]
    scores = ModuleType("sigmasplat.plugins.evaluation.evaluate")
    scores.evaluate = evaluate  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, scores.__name__, scores)
    for place in ("sigmasplat.plugins.sources", "sigmasplat.run.scene"):
        monkeypatch.setattr(f"{place}.open_source", lambda path, settings=None: source)
    monkeypatch.setattr(MadeUpSlam, "at", {}, raising=False)
    monkeypatch.setattr(MadeUpSlam, "lost", set(), raising=False)
    monkeypatch.setattr(MadeUpSlam, "tried", {}, raising=False)
    monkeypatch.setattr(MadeUpSlam, "every", 100, raising=False)
    monkeypatch.setattr(MadeUpSlam, "relocalised", set(), raising=False)
    monkeypatch.setattr(MadeUpSlam, "apart", {}, raising=False)
    monkeypatch.setattr(MadeUpSlam, "joined", set(), raising=False)
    monkeypatch.chdir(tmp_path)
    return source


GIVEN = dict[str, Any]()
"""The options of the last evaluation."""


def evaluate(run: RunFolder, source: Source, *, progress: Callable[[int, int], None], **options: Any) -> dict[str, Any]:
    """Replace the evaluation."""
    progress(1, 1)
    GIVEN.update(options)
    log = run.read_log()
    lost = [record["index"] for record in log if record["lost"]]
    metrics = METRICS | {"frames": len(log), "lost": len(lost), "lost_frames": lost}
    run.write_metrics(metrics)
    run.write_report("<html></html>")
    return metrics


def test_a_run_writes_all_files(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("run", "corridor", "--set", "tracking.tau=7", "--set", "mapping.every=2", "--seed", "4") == 0
    run = RunFolder.open(Path("runs/my-corridor-sigma"))
    config = run.config()
    assert (config.tracking.tau, config.mapping.every, config.seed) == (7.0, 2, 4)
    assert MadeUpSlam.latest.config == config
    assert run.facts()["status"] == "complete"
    assert run.facts()["wall_s"] > 0
    np.testing.assert_allclose(run.read_trajectory().T_world_camera[:, 0, 3], 0.1 * np.arange(6), atol=1e-12)
    assert torch.allclose(run.read_map().means, MadeUpSlam.latest.field.means)
    assert set(run.read_checkpoint()[0]) == {"field.params"}
    log = run.read_log()
    assert [record["index"] for record in log] == list(range(6))
    assert [record["is_keyframe"] for record in log] == [True, False, False, False, False, True]
    assert log[3]["T_world_camera"][0][3] == pytest.approx(0.3)
    assert log[3]["tracking"] == {"loss": None}
    assert all(record["submap"] == 0 and "loops" not in record for record in log) and run.read_loops() == []
    assert MadeUpSlam.latest.finished == 1 and len(run.read_map()) == 3, "the final map"
    assert run.facts()["finish_s"] >= 0.0
    said = capsys.readouterr().out
    for figure in ("1.23", "27.31", str(Path("runs/my-corridor-sigma/report.html").resolve())):
        assert figure in said
    assert "LOST" not in said


def test_only_valid_poses_are_in_the_trajectory(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    MadeUpSlam.lost, MadeUpSlam.relocalised, MadeUpSlam.apart = {1, 3}, {2}, {3: 1, 4: 1, 5: 2}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    run = RunFolder.open(Path("mine"))
    log = run.read_log()
    assert [record["state"] for record in log] == ["tracked", "lost", "relocalised", "lost", "apart", "apart"]
    assert [record["component"] for record in log] == [0, 0, 0, 1, 1, 2]
    assert [record["lost"] for record in log] == [False, True, False, True, False, False]
    assert {record["p_off"] for record in log} == {0.25}
    assert run.read_trajectory().timestamps_s.tolist() == [0.0, 2.0]
    assert run.component_numbers() == [1, 2] and run.read_component(1).trajectory.timestamps_s.tolist() == [4.0]
    assert torch.allclose(run.read_component(2).field.means, MadeUpSlam.latest.field.means)
    assert "6 frames, 2 lost, 1 relocalised, 2 components apart (2 frames)" in capsys.readouterr().out
    frames = run.read_frames()
    assert frames.states == ("tracked", "lost", "relocalised", "lost", "apart", "apart")
    assert frames.outside().tolist() == [False] * 4 + [True] * 2


def test_changes_of_state_are_printed(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    MadeUpSlam.lost, MadeUpSlam.relocalised, MadeUpSlam.apart = {1, 3}, {2}, {4: 1}
    assert exit_code("run", "corridor", "--no-eval") == 0
    said = capsys.readouterr().out
    assert "frame 2 (t = 2.000 s): relocalised; it was lost since frame 1" in said
    assert "frame 4: component 1 begins" in said and "frame 5: connected" in said


def test_the_progress_bar_shows_that_tracking_is_lost(corridor: Corridor) -> None:
    MadeUpSlam.lost = {3, 4, 5}
    out = io.StringIO()
    folder = RunFolder.create(Path("direct"), BASE, "corridor")
    with Screen(Console(file=out, force_terminal=True, width=120)).steps(6) as callback:
        Session(MadeUpSlam(BASE), corridor, folder, [callback]).execute()
    assert "LOST since frame 3" in out.getvalue()


def test_a_component_that_joins_later_is_in_the_trajectory(corridor: Corridor) -> None:
    MadeUpSlam.lost, MadeUpSlam.apart, MadeUpSlam.joined = {2}, {3: 1, 4: 1}, {1}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    run = RunFolder.open(Path("mine"))
    assert run.read_log()[3]["state"] == "apart", "the state of that time"
    assert run.read_frames().states == ("tracked", "tracked", "lost", "tracked", "tracked", "tracked")
    assert run.component_numbers() == []
    MadeUpSlam.joined = set()
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine", "--overwrite") == 0
    assert run.component_numbers() == [1]
    (run.path / "components" / "1" / "notes.txt").write_text("the user's")
    MadeUpSlam.apart = {}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine", "--overwrite") == 0
    assert sorted(p.name for p in (run.path / "components").rglob("*")) == ["1", "notes.txt"]


def test_a_second_run_gets_a_numbered_folder(corridor: Corridor) -> None:
    for _ in range(3):
        assert exit_code("run", "corridor", "--no-eval") == 0
    names = sorted(path.name for path in Path("runs").iterdir())
    assert names == [f"my-corridor-sigma{ending}" for ending in ("", "-2", "-3")]


def test_overwrite_replaces_the_default_folder(corridor: Corridor) -> None:
    assert exit_code("run", "corridor", "--no-eval") == 0
    assert exit_code("run", "corridor", "--no-eval", "--overwrite", "--preset", "sigma") == 0
    assert [path.name for path in Path("runs").iterdir()] == ["my-corridor-sigma"]
    assert len(RunFolder.open(Path("runs/my-corridor-sigma")).read_log()) == 6


def test_lost_frames_are_printed(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    MadeUpSlam.lost = {2, 3, 5}
    assert exit_code("run", "corridor") == 0
    said = capsys.readouterr().out
    assert "frame 2 (t = 2.000 s): tracking lost (20% of the image supports the pose)" in said
    assert "frame 4 (t = 4.000 s): tracking recovered; it was lost since frame 2" in said
    assert "3 of 6 images have no pose (2–3, 5)" in said
    assert said.count("tracking lost") == 2


@pytest.mark.skipif(not hasattr(signal, "raise_signal"), reason="needs signals")
@pytest.mark.parametrize("number", ENDING)
def test_signals_that_end_a_process_finish_the_frame_and_leave_a_valid_folder(
    corridor: Corridor, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setattr(os, "isatty", lambda _: False)  # a closed terminal would be silent from then on
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL), signal.getsignal(number)
    MadeUpSlam.at = {3: lambda: os.kill(os.getpid(), number)}
    assert exit_code("run", "corridor", "--out", "cut") == 130
    run = RunFolder.open(Path("cut"))
    assert run.facts()["status"] == "interrupted"
    assert len(run.read_log()) == len(run.read_trajectory()) == 4
    assert len(run.read_map()) == 2
    assert run.read_checkpoint()[0]
    assert "interrupted after 4 frames" in capsys.readouterr().out
    assert signal.getsignal(number) is before[1]
    signal.signal(signal.SIGHUP, before[0])


def test_a_sighup_that_is_ignored_stays_ignored(corridor: Corridor) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    MadeUpSlam.at = {3: lambda: os.kill(os.getpid(), signal.SIGHUP)}
    assert exit_code("run", "corridor", "--out", "whole") == 0
    assert signal.signal(signal.SIGHUP, before) is signal.SIG_IGN
    assert RunFolder.open(Path("whole")).facts()["status"] == "complete"


def test_a_second_ctrl_c_stops_at_once(corridor: Corridor) -> None:
    def twice() -> None:
        first = signal.getsignal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        while signal.getsignal(signal.SIGINT) is first:  # not handled yet: two signals at once would count as one
            time.sleep(0.001)
        signal.raise_signal(signal.SIGINT)
        time.sleep(1.0)

    MadeUpSlam.at = {3: twice}
    assert exit_code("run", "corridor", "--out", "cut") == 130
    run = RunFolder.open(Path("cut"))
    assert run.facts()["status"] == "interrupted"
    assert len(run.read_log()) == len(run.read_trajectory()) == 3


def test_a_crash_keeps_its_traceback_and_names_the_folder(corridor: Corridor) -> None:
    def crash() -> None:
        raise ZeroDivisionError("a bug")

    MadeUpSlam.at = {2: crash}
    with pytest.raises(ZeroDivisionError, match="a bug") as crashed:
        cli.main(["run", "corridor", "--out", "crashed"])
    assert "crashed" in "".join(crashed.value.__notes__)
    run = RunFolder.open(Path("crashed"))
    assert run.facts()["status"] == "failed"
    assert len(run.read_trajectory()) == 2


@pytest.mark.parametrize("problem", [ZeroDivisionError("a bug"), SigmaSplatError("no depth"), KeyboardInterrupt()])
def test_a_run_that_fails_before_its_first_frame_leaves_no_folder(corridor: Corridor, problem: BaseException) -> None:
    def fail() -> None:
        raise problem

    MadeUpSlam.at = {0: fail}
    with pytest.raises((SystemExit, ZeroDivisionError)) as left:
        cli.main(["run", "corridor"])
    assert not getattr(left.value, "__notes__", []), "no folder exists"
    assert not any(Path().iterdir()), "not even runs/"


def test_a_failed_run_keeps_a_folder_with_files_of_the_user(corridor: Corridor) -> None:
    def fail() -> None:
        Path("mine/notes.txt").write_text("the user's")
        raise SigmaSplatError("no depth")

    MadeUpSlam.at = {0: fail}
    assert exit_code("run", "corridor", "--out", "mine") == 2
    assert Path("mine/notes.txt").read_text() == "the user's" and Path("mine/run.json").is_file()


CLOSED, REFUSED, LAST = MadeUpLoop(7, 0, True), MadeUpLoop(7, 2, False), MadeUpLoop(8, 1, True, 0.0149, 0.1206)


def test_submaps_and_loops_are_stored_and_printed(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    MadeUpSlam.every = 2
    MadeUpSlam.tried = {4: [CLOSED, REFUSED], "end": [LAST]}
    stored_while_running: list[list[dict[str, Any]]] = []
    MadeUpSlam.at = {5: lambda: stored_while_running.append(RunFolder.open(Path("mine")).read_log()[4]["loops"])}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    run, log = RunFolder.open(Path("mine")), RunFolder.open(Path("mine")).read_log()
    assert [record["submap"] for record in log] == [0, 0, 1, 1, 2, 2]
    assert [len(record.get("loops", [])) for record in log] == [0, 0, 0, 0, 2, 0]
    assert log[4]["loops"][1] == {"query": 7, "database": 2, "accepted": False, "residual": 0.02149,
                                  "translation_m": 0.043, "chi2": None}  # fmt: skip
    assert [[loop["database"] for loop in loops] for loops in stored_while_running] == [[0, 2]], (
        "the log of a killed run has them"
    )
    assert [loop["database"] for loop in run.read_loops()] == [0, 2, 1]
    said = capsys.readouterr().out
    assert "frame 4: loop closed between submaps 7 and 0 (residual 0.021, moved 4.3 cm)" in said
    assert "at the end: loop closed between submaps 8 and 1 (residual 0.015, moved 12.1 cm)" in said
    assert said.count("loop closed") == 2
    assert "\nfinal map 0/2\n" in said and "\nfinal map 2/2\n" in said
    assert "3 submaps, loops: 2 closed, 1 refused" in said
    store = MadeUpSlam.latest.store
    assert isinstance(store, DiskStore) and store.folder == Path("mine/submaps")


def test_loops_are_stored_with_their_latest_verdict(corridor: Corridor) -> None:
    loop = MadeUpLoop(7, 0, True)
    MadeUpSlam.tried = {2: [loop]}
    MadeUpSlam.at = {4: lambda: setattr(loop, "accepted", False)}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    assert not RunFolder.open(Path("mine")).read_loops()[0]["accepted"]
    assert RunFolder.open(Path("mine")).read_log()[2]["loops"][0]["accepted"], "the log has the verdict of that time"


def test_the_time_of_the_final_map_is_separate_from_that_of_the_frames(
    corridor: Corridor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [0.0]

    def pass_time(seconds: float) -> Callable[[], None]:
        return lambda: now_s.__setitem__(0, now_s[0] + seconds)

    monkeypatch.setattr("sigmasplat.run.session.time.perf_counter", lambda: now_s[0])
    MadeUpSlam.at = {3: pass_time(5.0), "loops": pass_time(30.0), "finish 1": pass_time(70.0)}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    facts = RunFolder.open(Path("mine")).facts()
    assert (facts["wall_s"], facts["finish_s"]) == (5.0, 100.0)


@pytest.mark.parametrize("moment", ["loops", "finish 1"])
def test_ctrl_c_during_the_final_map_keeps_all_results(
    corridor: Corridor, capsys: pytest.CaptureFixture[str], moment: str
) -> None:
    MadeUpSlam.at = {moment: lambda: signal.raise_signal(signal.SIGINT)}
    MadeUpSlam.tried = {4: [CLOSED], "end": [LAST]}
    assert exit_code("run", "corridor", "--out", "cut") == 130
    assert MadeUpSlam.latest.finished == 0
    run = RunFolder.open(Path("cut"))
    assert run.facts()["status"] == "interrupted" and run.facts()["wall_s"] > 0 and "finish_s" not in run.facts()
    assert len(run.read_log()) == len(run.read_trajectory()) == 6
    assert len(run.read_map()) == 2 and len(run.read_loops()) == 2 and run.read_checkpoint()[0]
    assert "interrupted after 6 frames" in capsys.readouterr().out
    assert not (run.path / "metrics.json").exists()


def test_ctrl_c_after_the_last_step_changes_nothing(corridor: Corridor) -> None:
    MadeUpSlam.at = {"finish 2": lambda: signal.raise_signal(signal.SIGINT)}
    assert exit_code("run", "corridor", "--no-eval", "--out", "mine") == 0
    assert RunFolder.open(Path("mine")).facts()["status"] == "complete"


def test_a_run_interrupted_between_frames_makes_no_final_map(corridor: Corridor) -> None:
    MadeUpSlam.at = {3: lambda: signal.raise_signal(signal.SIGINT)}
    MadeUpSlam.tried = {2: [CLOSED]}
    assert exit_code("run", "corridor", "--out", "cut") == 130
    run = RunFolder.open(Path("cut"))
    assert MadeUpSlam.latest.finished == 0 and "finish_s" not in run.facts() and len(run.read_loops()) == 1


def test_a_crash_during_the_final_map_keeps_all_results(corridor: Corridor) -> None:
    def crash() -> None:
        raise ZeroDivisionError("a bug")

    MadeUpSlam.at = {"finish 1": crash}
    with pytest.raises(ZeroDivisionError, match="a bug") as crashed:
        cli.main(["run", "corridor", "--out", "crashed"])
    assert "crashed" in "".join(crashed.value.__notes__)
    run = RunFolder.open(Path("crashed"))
    assert run.facts()["status"] == "failed" and "finish_s" not in run.facts()
    assert len(run.read_trajectory()) == 6 and len(run.read_map()) == 2 and run.read_checkpoint()[0]


def test_the_end_of_a_run_is_a_sentence_six_figures_and_the_next_commands(
    corridor: Corridor, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("run", "corridor", "--out", "my room") == 0
    said = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in said[said.index("All 6 images") :].splitlines()]
    assert lines[0] == ("All 6 images have a pose, the RMS error of the path is 1.2 cm; the map is good: 27.3 dB PSNR.")
    assert lines[1:5] == ["Images with a pose 6 of 6", "ATE RMSE 1.23 cm", "PSNR, held-out images 27.31 dB",
                          "Depth L1, held-out images – cm"]  # fmt: skip
    assert lines[7].startswith("report: ") and lines[7].endswith("report.html")
    assert lines[8:] == ["next: sigmasplat view 'my room'", "sigmasplat share 'my room' --out 'my room'.html",
                         "sigmasplat mesh 'my room' --out 'my room'.glb"]  # fmt: skip
    assert exit_code("run", "corridor", "--out", "unscored", "--no-eval") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "next: sigmasplat eval unscored"


def test_a_terminal_shows_progress_bars(corridor: Corridor) -> None:
    out = io.StringIO()
    screen = Screen(Console(file=out, force_terminal=True, width=120))
    MadeUpSlam.tried = {4: [CLOSED]}
    folder = RunFolder.create(Path("direct"), BASE, "corridor")
    with screen.steps(6) as callback:
        Session(MadeUpSlam(BASE), corridor, folder, [callback]).execute()
    said = out.getvalue()
    assert "SLAM" in said and "6/6" in said and "final map" in said and "2/2" in said and "loop closed" in said


def test_a_slow_run_says_seconds_per_frame_and_the_time_left(
    corridor: Corridor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = itertools.count(0.0, 60.0)
    monkeypatch.setattr("sigmasplat.run.terminal.time.perf_counter", lambda: next(now_s))
    out, folder = io.StringIO(), RunFolder.create(Path("direct"), BASE, "corridor")
    with Screen(Console(file=out, width=120)).steps(6) as callback:
        Session(MadeUpSlam(BASE), corridor, folder, [callback]).execute()
    minutes = [int(found) for found in re.findall(r"\d+\.\d s per frame, about (\d+) min left", out.getvalue())]
    assert minutes and minutes == sorted(minutes, reverse=True) and "frames/s" not in out.getvalue()


def test_unreadable_images_are_counted(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    corridor.broken = {1, 4}
    assert exit_code("run", "corridor", "--no-eval", "--out", "some") == 0
    assert "2 images skipped (first: 1.png is truncated)" in capsys.readouterr().err
    facts = json.loads(Path("some/run.json").read_text())
    assert facts["skipped"] == ["1.png is truncated", "4.png is truncated"]
    assert [record["index"] for record in RunFolder.open(Path("some")).read_log()] == [0, 2, 3, 5]


def test_strict_stops_with_one_line_and_keeps_the_results(
    corridor: Corridor, capsys: pytest.CaptureFixture[str]
) -> None:
    corridor.broken, corridor.strict = {3}, True
    assert exit_code("run", "corridor", "--out", "strict") == 2
    assert capsys.readouterr().err.strip() == "sigmasplat: 3.png is truncated"
    run = RunFolder.open(Path("strict"))
    assert run.facts()["status"] == "failed"
    assert len(run.read_trajectory()) == 3


def test_a_wrong_depth_unit_gives_a_warning(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    corridor.depth_m = 2000.0
    assert exit_code("run", "corridor", "--no-eval") == 0
    err = capsys.readouterr().err
    assert err.startswith("warning: ")
    assert "2000 m" in err


def test_options_of_eval_reach_the_evaluation(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("run", "corridor", "--out", "mine") == 0
    plain = {
        "mesh": False, "true_mesh": None, "random_views": 1000, "full_resolution": False, "lpips": None,
    }  # fmt: skip
    assert plain == GIVEN and "LPIPS" not in capsys.readouterr().out
    write_mesh(Path("wall.ply"), Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)))
    write_weights(Path("data/lpips/alex"))
    given = ("--true-mesh", "wall.ply", "--random-views", "7", "--full-resolution")
    assert exit_code("eval", "mine", *given) == 0
    assert GIVEN["mesh"] and len(GIVEN["true_mesh"].faces) == 1 and GIVEN["lpips"].net == "alex"
    assert (GIVEN["random_views"], GIVEN["full_resolution"]) == (7, True)
    Path("data/lpips/alex/alex.pth").unlink()
    assert exit_code("eval", "mine") == 0
    assert GIVEN["lpips"] is None and "no alex.pth in data/lpips" in capsys.readouterr().out


@pytest.mark.parametrize("preset", ["varsplat-fast", "varsplat-tum", "cgslam-tum", "cgslam-released-fr1-desk"])
def test_a_preset_with_netvlad_gives_a_warning_without_weights(
    corridor: Corridor, capsys: pytest.CaptureFixture[str], preset: str
) -> None:
    assert exit_code("run", "corridor", "--preset", preset, "--no-eval") == 0
    warned = "no NetVLAD weights, so the built-in descriptor is used" in capsys.readouterr().err
    assert warned == (preset in ("varsplat-tum", "cgslam-released-fr1-desk"))


def test_eval_and_export_read_what_run_wrote(corridor: Corridor, capsys: pytest.CaptureFixture[str]) -> None:
    exit_code("run", "corridor", "--no-eval", "--out", "mine", "--limit", "5", "--hold-out", "3")
    assert RunFolder.open(Path("mine")).config().input.hold_every == 3
    assert exit_code("eval", "mine") == 0
    assert "27.31" in capsys.readouterr().out
    assert RunFolder.open(Path("mine")).read_metrics()["frames"] == 6
    assert exit_code("export", "mine", "--axes", "camera") == 0
    assert torch.allclose(read_field(Path("mine.ply")).params, RunFolder.open(Path("mine")).read_map().params)
    assert exit_code("export", "mine", "--out", "path.txt") == 0
    assert len(read_poses(Path("path.txt"))) == 6
    assert exit_code("export", "mine") == 2
    assert "mine.ply exists" in capsys.readouterr().err
    assert exit_code("export", "mine", "--overwrite", "--format", "ply") == 0


def test_a_session_runs_without_a_terminal(corridor: Corridor) -> None:
    folder = RunFolder.create(Path("direct"), BASE, "corridor")
    outcome = Session(MadeUpSlam(BASE), corridor, folder).execute()
    assert (outcome.status, outcome.frames, outcome.lost) == ("complete", 6, 0)
    assert outcome.wall_s > 0


@pytest.mark.parametrize("measured", [True, False])
def test_a_run_writes_the_vertical_direction_that_an_accelerometer_measured(
    corridor: Corridor, monkeypatch: pytest.MonkeyPatch, measured: bool
) -> None:
    plain = Corridor.frame

    def frame(self: Corridor, i: int) -> Frame:
        force = np.array([9.81, 0.3 * (-1) ** i, 0.0]) if measured else None
        return replace(plain(self, i), specific_force_m_s2=force)

    monkeypatch.setattr(Corridor, "__len__", lambda self: 12)
    monkeypatch.setattr(Corridor, "frame", frame)
    run = RunFolder.create(Path("sideways"), BASE, "corridor")
    Session(MadeUpSlam(BASE), corridor, run).execute()
    if measured:
        assert noted_up(run.facts()) == pytest.approx([1.0, 0.0, 0.0])
        assert run.read_log()[1]["specific_force_m_s2"] == pytest.approx([9.81, -0.3, 0.0])
    else:
        assert noted_up(run.facts()) is None and "specific_force_m_s2" not in run.read_log()[0]
