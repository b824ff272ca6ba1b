"""Kill runs, evaluations and exports at file operations, or cut the power, and check that nothing is lost.

Each case is one command on 12 tiny frames of the synthetic room: `run`, `eval`, `mesh` or `export`. Its process is
killed (-9) at one of its file operations, or up to 3 ms later. For a power failure, everything that was not synced is
lost at random as well (power_loss.py). Then all files are read, and the next command is the one that a user would give:
`resume`, or the same command again. Half of the cases are killed again in that command. A case passes if no file is
half, at most one frame is processed again, and the end is the same as without a kill. Linux only.

example: python benchmarks/crashes.py --kills 4 --power-cuts 2 --quick
"""

import json
import math
import random
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import crash_process
import power_loss
import program
import record
import tyro
from crash_process import Ended, Kill
from PIL import Image
from splat_readers import read_any
from tables import Section

from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.files.tensors import open_tensors
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.outputs.mesh_files import read_mesh
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
KILLED = -9
RESULTS = ("map.ply", "uncertainty", "checkpoint", "trajectory")
FRAMES, MOST_AGAIN, MOST_CRASHES, LONGEST_DELAY_S = 12, 1, 3, 0.003
ROOM = "synthetic:frames=60,width=64,height=48"
SETTINGS = {
    "input.width": 64, "input.limit": FRAMES, "mapping.first_iterations": 4, "mapping.iterations": 2,
    "mapping.every": 3, "submaps.frames": 4, "final.iterations": 4, "registration.iterations": 2,
    "uncertainty.probes": 1,
}  # fmt: skip
STAGES = {"run": 0.6, "eval": 0.2, "mesh": 0.1, "export": 0.1}
"""The commands whose processes are killed, in their order, and the shares of the cases. A case starts with a copy of
what the commands before have written."""
KINDS = ("kill -9", "power failure")


@dataclass(frozen=True)
class Options:
    """Kill runs, evaluations and exports at file operations, or cut the power, and check that nothing is lost."""

    kills: Annotated[int, arg(help="number of cases with kill -9")] = 200
    power_cuts: Annotated[int, arg(help="number of cases with a power failure")] = 100
    seed: Annotated[int, arg(help="seed of the places of the kills")] = 0
    quick: Annotated[bool, arg(help="print the tables, write no results", help_behavior_hint="")] = False
    scratch: Annotated[Path | None, arg(help="folder of temporary files; default: that of the system")] = None
    name: Annotated[str, arg(help="name of the results")] = "crashes"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass
class Case:
    """One command with its kills, in a folder of its own."""

    folder: Path
    stage: str
    kind: str = ""
    chance: random.Random = field(default_factory=random.Random)
    crashes: list[str] = field(default_factory=list)
    again: int = 0
    losses: int = 0
    problem: str = ""

    @property
    def watched(self) -> Path:
        """Return the folder in which operations are recorded."""
        return self.folder / "watched"

    @property
    def run(self) -> Path:
        """Return the run folder."""
        return self.watched / "run"

    def command(self) -> list[str]:
        """Return the arguments of the stage's command."""
        settings = [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
        run = str(self.run)
        return {
            "run": ["run", ROOM, "--out", run, "--overwrite", "--no-eval", "--save-every", "1e-9", *settings],
            "eval": ["eval", run],
            "mesh": ["mesh", run, "--voxel-m", "0.05"],
            "export": ["export", run, "--out", str(self.watched / "map.spz"), "--overwrite"],
        }[self.stage]

    def next(self) -> list[str]:
        """Return the command that a user gives after a kill, empty if the run is complete."""
        if self.stage != "run":
            return self.command()
        try:
            status = RunFolder.open(self.run).facts()["status"]
        except SigmaSplatError:
            return self.command()
        if status == "complete":
            return []
        has_state = RunFolder(self.run).state.is_file()
        return ["resume", str(self.run), "--no-eval", "--save-every", "1e-9"] if has_state else self.command()

    def execute(self, arguments: Sequence[str], kill: Kill | None = None) -> Ended:
        """Run a command. If it is killed, note when, and lose what a power failure loses."""
        self.watched.mkdir(parents=True, exist_ok=True)
        before = power_loss.durable_sizes(self.watched)
        ended = crash_process.run(arguments, self.watched, self.folder, kill)
        if ended.code == KILLED:
            self.crashes.append(phase(arguments[0], ended))
            logged = lines(self.run)
            if self.kind == "power failure":
                self.losses += power_loss.lose(self.watched, ended.operations, before, self.chance)
            if self.stage == "run" and self.next():
                self.again = max(self.again, logged - saved_frames(self.run))
        elif ended.code:
            self.problem = f"{arguments[0]} ended with {ended.code}: {ended.output.strip().splitlines()[-1:]}"
        return ended


def complete(case: Case, kill: Kill) -> None:
    """Run the command of a case with a kill, then what a user gives next, half of the time with more kills."""
    kills: list[Kill | None] = [kill]
    for _ in range(case.chance.choice((0, 0, 1, MOST_CRASHES - 1))):
        kills.append(Kill(case.chance.randint(1, 60), case.chance.choice((0.0, LONGEST_DELAY_S))))
    arguments = case.command()
    while arguments and not case.problem:
        if case.execute(arguments, kills.pop(0) if kills else None).code != KILLED:
            break
        case.problem = half_file(case)
        arguments = case.next()
    if case.again > MOST_AGAIN:
        case.problem = case.problem or f"{case.again} frames are processed again"
    with RunFolder(case.run).locked():
        RunFolder(case.run).remove_leftovers()  # as the next command that writes there


def lines(run: Path) -> int:
    """Return the number of lines of log.jsonl."""
    log = run / "log.jsonl"
    return log.read_bytes().count(b"\n") if log.is_file() else 0


def saved_frames(run: Path) -> int:
    """Return the number of frames in the saved state, 0 without one."""
    state = RunFolder(run).state
    if not state.is_file():
        return 0
    with open_tensors(state, "state") as file:
        tree = json.loads(file.get_tensor("state").numpy().tobytes())
    return next(int(value) + 1 for key, value in tree["dict"] if key == "index")


def phase(command: str, ended: Ended) -> str:
    """Return what the killed process was doing."""
    if command not in ("run", "resume"):
        return command
    paths = [o["path"] for o in ended.operations if o["kind"] in ("create", "write", "rename")]
    if command == "run" and not any(path.endswith("log.jsonl") for path in paths):
        return "start"
    if any(name in path for path in paths[-4:] for name in RESULTS):
        return "final map and results"
    if any("/submaps/" in path for path in paths[-3:]):
        return "cut"
    return "resume" if command == "resume" and len(ended.operations) < 12 else "frames"


def half_file(case: Case) -> str:
    """Return the first file under a final name that cannot be read; the log may end in a damaged line."""
    for path in sorted(case.watched.rglob("*")):
        if path.is_file() and not path.name.startswith(".") and path.name != "log.jsonl":
            try:
                READERS[path.suffix](path)
            except Exception as problem:
                return f"{path.name} is half: {problem}"
    return ""


def read_tensors(path: Path) -> None:
    """Read all tensors of a file."""
    with open_tensors(path, "file") as file:
        for name in file.keys():  # noqa: SIM118
            file.get_tensor(name)


def read_page(path: Path) -> None:
    """Read a report to its end."""
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError("no </html>")


def read_image(path: Path) -> None:
    """Decode an image."""
    with Image.open(path) as image:
        image.load()


READERS: dict[str, Callable[[Path], Any]] = {
    ".json": lambda path: json.loads(path.read_text(encoding="utf-8")), ".safetensors": read_tensors,
    ".ply": lambda path: read_mesh(path) if path.name == "mesh.ply" else read_any(path), ".spz": read_any,
    ".txt": lambda path: read_poses(path, may_be_empty=True), ".html": read_page, ".png": read_image,
}  # fmt: skip


def content(case: Case) -> dict[str, Any]:
    """Return the content of all files, without measured times."""
    return {
        str(path.relative_to(case.watched)): TIMELESS.get(path.name, Path.read_bytes)(path)
        for path in sorted(case.watched.rglob("*"))
        if path.is_file()
    }


def timeless_log(path: Path) -> Any:
    """Return the lines of log.jsonl without seconds."""
    log = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [{key: value for key, value in line.items() if key != "seconds"} for line in log]


def timeless_json(path: Path) -> Any:
    """Return a JSON object without times, rates, and the commit, which changes if the checkout is edited meanwhile."""
    values = json.loads(path.read_text(encoding="utf-8"))
    return {key: value for key, value in values.items() if not key.endswith("_s") and key != "code"}


def name_only(path: Path) -> str:
    """Return the name of a file that shows times."""
    return path.name


TIMELESS: dict[str, Callable[[Path], Any]] = {
    "log.jsonl": timeless_log, "run.json": timeless_json, "metrics.json": timeless_json,
    "report.html": name_only,
}  # fmt: skip


def difference(case: Case, expected: dict[str, Any]) -> str:
    """Return the first content that differs from that of the case without a kill."""
    found = content(case)
    names = [name for name in {**expected, **found} if found.get(name) != expected.get(name)]
    return f"{names[0]} differs" if names else ""


@dataclass(frozen=True)
class Start:
    """A stage: its files before and after its command without a kill, and how many operations it has."""

    before: Path
    expected: dict[str, Any]
    operations: int


def starts(scratch: Path) -> dict[str, Start]:
    """Run all commands without a kill."""
    whole, found = Case(scratch / "whole", "run"), dict[str, Start]()
    for stage in STAGES:
        whole.stage = stage
        before = scratch / f"before-{stage}"
        whole.watched.mkdir(parents=True, exist_ok=True)
        shutil.copytree(whole.watched, before)
        operations = len(whole.execute(whole.command()).operations)
        if whole.problem:
            raise SourceError(whole.problem)
        found[stage] = Start(before, content(whole), operations)
    return found


def measure(options: Options) -> dict[str, Any]:
    """Run all cases; return the number of operations of each command, and each case."""
    with TemporaryDirectory(prefix="crashes-", dir=options.scratch) as scratch:
        of_stage = starts(Path(scratch))
        cases = [
            one_case(Path(scratch) / "case", kind, stage, number, math.ceil(share * count), options.seed, of_stage)
            for kind, count in zip(KINDS, (options.kills, options.power_cuts), strict=True)
            for stage, share in STAGES.items()
            for number in range(math.ceil(share * count))
        ]
    return {"operations": {stage: start.operations for stage, start in of_stage.items()}, "cases": cases}


def one_case(
    folder: Path, kind: str, stage: str, number: int, count: int, seed: int, of_stage: dict[str, Start]
) -> dict[str, Any]:
    """Run one of `count` cases, whose first kills are spread evenly over the operations; return its record."""
    chance, start = random.Random(f"{seed} {kind} {stage} {number}"), of_stage[stage]
    at = 1 + int((number + chance.random()) * start.operations / count)
    case = Case(folder, stage, kind, chance)
    shutil.copytree(start.before, case.watched)
    complete(case, Kill(at, chance.choice((0.0, chance.uniform(0.0, LONGEST_DELAY_S)))))
    case.problem = case.problem or difference(case, start.expected)
    print(f"{kind}, {stage} at {at}: {', '.join(case.crashes)} {case.problem}", file=sys.stderr, flush=True)
    shutil.rmtree(folder)
    return {"kind": kind, "stage": stage, "at": at, "crashes": case.crashes, "again": case.again,
            "losses": case.losses, "problem": case.problem}  # fmt: skip


def sections(measured: dict[str, Any]) -> list[Section]:
    """Lay out the cases by kind and by what the process was doing at its first kill."""
    cases, rows = measured["figures"]["cases"], []
    for kind in KINDS:
        of_kind = [case for case in cases if case["kind"] == kind and case["crashes"]]
        for doing in sorted({case["crashes"][0] for case in of_kind}):
            rows.append(row(kind, doing, [case for case in of_kind if case["crashes"][0] == doing]))
        if of_kind:
            rows.append(row(kind, "**all**", of_kind))
    failed = [[c["kind"], str(c["at"]), ", ".join(c["crashes"]), c["problem"]] for c in cases if c["problem"]]
    heads = ("", "first kill during", "cases", "kills", "same end", "frames again, at most")
    note = "Frames again: frames that were logged, and are processed again after the kill."
    made = [Section("Crashes", heads, rows, note)]
    return made + ([Section("Failed", ("", "at operation", "during", "problem"), failed)] if failed else [])


def row(kind: str, doing: str, cases: Sequence[dict[str, Any]]) -> list[str]:
    """Return a row of the table."""
    kills, same = sum(len(case["crashes"]) for case in cases), sum(not case["problem"] for case in cases)
    return [kind, doing, str(len(cases)), str(kills), str(same), str(max(case["again"] for case in cases))]


def main(options: Options) -> int:
    """Run the cases, print the tables, and write the results unless `quick`."""
    return program.run("crashes", options, measure, seeds=(options.seed,), write=not options.quick)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
