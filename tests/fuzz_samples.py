"""Small valid inputs of every format, as files in memory, with the commands that read them."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import torch

import layouts
import recordings
from bag_recordings import Recorder, aligned
from command_line import exit_code
from room_run import made_run
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS
from sigmasplat.commands.options import configured
from sigmasplat.data.field import GaussianField
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.presets.table_files import TABLES
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.resume import StateFile
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.runs import RunFolder

Files = dict[str, bytes]
INPUT, OUT = "INPUT", "OUT"
"""Words of a command that stand for the input and for a new path beside it."""
QUICK = tuple(
    word
    for setting in ("input.width=32", "mapping.first_iterations=2", "mapping.iterations=1", "tracking.iterations=2",
                    "final.iterations=1")
    for word in ("--set", setting)
)  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """A valid input: its files by relative path, the path that a command gets, and the commands that read it.

    weight: share among all samples; slow: its commands take a second or more.
    """

    name: str
    files: Files
    entry: str
    commands: tuple[tuple[str, ...], ...]
    weight: float = 1.0


INSPECT = ("inspect", INPUT, "--out", f"{OUT}.png")
RUN = ("run", INPUT, "--out", OUT, "--no-eval", "--limit", "200", *QUICK)  # thousands of frames take their time
READ = (RUN,) * 9 + (INSPECT,)
"""Commands that read a recording: `inspect` takes eight times as long as a run of four tiny frames."""
EXPORTS = tuple(("export", INPUT, "--out", f"{OUT}{ending}") for ending in (".ply", ".spz", ".glb"))
OF_RUN = tuple(
    ("export", INPUT, "--format", name, "--out", OUT) for name in ("trajectory", "colmap", "spz", "covariance")
)
OF_FINISHED = (
    ("eval", INPUT),
    ("mesh", INPUT, "--out", f"{OUT}.ply"),
    ("export", INPUT, "--format", "plan", "--out", f"{OUT}.png"),
    ("export", INPUT, "--format", "covariance", "--out", OUT),
    ("localise", "synthetic:frames=1", "--in", INPUT),
    ("view", INPUT, "--port", "0"),
)
ROOM = "synthetic:frames=3,width=48,height=36"
OPTIONS = """--limit
2
--stride
1
--start
0
--end
9.5
--hold-out
2
--fx
40
--cx
24
--depth-scale
1
--seed
1
--save-every
5.5
--set
input.width=32
--set
input.max_depth_m=8.5
--set
mapping.every=1
--set
tracking.tau=3
--set
loops.near_m=0.5
--set
submaps.frames=2
--set
seeding.shape=pixel
--calibration
INPUT
--register-depth
auto
"""
"""Options of `run`, one word per line. None of them makes a run of two frames long."""


def samples(folder: Path) -> Iterator[Sample]:
    """Make the samples below a new folder."""
    for name, layout in layouts.LAYOUTS.items():
        place = folder / name
        path = layout.write(place, layouts.sample())
        if layout.size == layouts.VGA:  # small images, so the calibration must be given
            fields = asdict(layouts.SMALL_CAMERA) | {
                "depth_scale": 5000 if name in ("tum", "bonn", "icl_nuim") else 1000
            }
            layouts.save_text(path / "calibration.json", json.dumps(fields))
        yield _sample(name, place, path, READ)
    yield from _npy(folder)
    yield from _phones(folder)
    yield from _bags(folder)
    yield from _maps(folder)
    yield from _runs(folder)
    yield from _studies(folder)
    yield from _poses(folder)


def _sample(name: str, place: Path, entry: Path, commands: tuple[tuple[str, ...], ...], weight: float = 1.0) -> Sample:
    files = {str(path.relative_to(place)): path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}
    return Sample(name, files, str(entry.relative_to(place)), commands, weight)


def _npy(folder: Path) -> Iterator[Sample]:
    path = layouts.plain(folder / "npy", layouts.sample())
    for number, depth in enumerate(layouts.sample().depth_mm):
        (path / f"depth/{number + 8}.png").unlink()
        np.save(path / f"depth/{number + 8}.npy", depth / np.float32(1000.0))
    yield _sample("npy", folder / "npy", path, READ)


def _phones(folder: Path) -> Iterator[Sample]:
    (folder / "stray").mkdir()
    path = recordings.write_stray(folder / "stray" / "walk", recordings.scene())
    rows = "".join(f"{1000 + i / 100:.3f}, 0, 0, 9.8, 0.1, 0.2, 0.05\n" for i in range(20))
    (path / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n" + rows)
    yield _sample("stray", folder / "stray", path, READ)
    (folder / "r3d").mkdir()
    members = recordings.r3d_members(recordings.scene())
    yield _sample("r3d", folder / "r3d", recordings.write_zip(folder / "r3d" / "walk.r3d", members), READ)
    path = recordings.write_exr_export(folder / "exr" / "walk", recordings.scene())
    yield _sample("exr", folder / "exr", path, READ)


def _bags(folder: Path) -> Iterator[Sample]:
    for name, ros1, storage in (("bag1", True, ""), ("sqlite", False, "sqlite3"), ("mcap", False, "mcap")):
        (folder / name).mkdir()
        recorder = aligned(Recorder(ros1), recordings.scene())
        path = recorder.write(folder / name / ("walk.bag" if ros1 else "walk"), storage)
        yield _sample(name, folder / name, path, READ)


def _maps(folder: Path) -> Iterator[Sample]:
    field = GaussianField(torch.randn(6, 17, generator=torch.Generator().manual_seed(0)))
    field.get_or_create("harmonics").params[:] = 0.25
    place = folder / "map.ply"
    place.mkdir()
    ply.write_field(place / "map.ply", field)
    yield _sample("map.ply", place, place / "map.ply", EXPORTS, 3.0)


def _runs(folder: Path) -> Iterator[Sample]:
    for name, submaps in (("run", True), ("whole_run", False)):
        run = made_run(folder / name / "walk", submaps)
        run.note(status="complete", source_path="synthetic:frames=6,width=40,height=30")
        yield _sample(name, folder / name, run.path, OF_RUN, 2.0)
    place = folder / "resumed"
    path = place / "walk"
    with mock.patch.object(StateFile, "delete"):  # keeps the state, as an interruption does
        code = exit_code("run", "synthetic:frames=3,width=48,height=36", "--out", str(path), "--no-eval", *QUICK)
    assert code == 0
    RunFolder(path).note(status="interrupted")
    yield _sample("resumed", place, path, (("resume", INPUT, "--no-eval"),), 1.5)
    RunFolder(path).note(status="complete")
    yield _sample("finished", place, path, OF_FINISHED, 1.0)


def _studies(folder: Path) -> Iterator[Sample]:
    """Make the files of commands that make many runs, and options. Their runs are finished, or their scenes missing."""
    place = folder / "options"
    layouts.save_text(place / "calibration.json", json.dumps(asdict(layouts.SMALL_CAMERA) | {"depth_scale": 1}))
    layouts.save_text(place / "options.txt", OPTIONS)
    words = ("run", ROOM, "--out", OUT, "--no-eval", *QUICK, "@options.txt")
    yield _sample("options", place, place / "calibration.json", (words,))
    metrics = {"ate": {"rmse_m": 0.01}, "held_out": {"psnr_db": 20.0}, "lost": 0, "frames_per_s": 9.0}
    place = folder / "table"
    text = (TABLES / "cgslam-ablation.toml").read_text(encoding="utf-8")
    layouts.save_text(place / "table.toml", text)
    table = ("bench", "table", INPUT, "--data", f"{INPUT}/..", "--out", OUT)
    yield _sample("table", place, place / "table.toml", (table,), 0.5)
    name = "synthetic-frames-3-width-48-height-36"
    run = RunFolder(folder / "batch" / name)
    shutil.copytree(folder / "resumed" / "walk", run.path)
    config = configured("sigma", tuple(word for word in QUICK if word != "--set"), None, DEFAULT_INPUT_OPTIONS)
    run.note(status="complete", batch=Job(name, (ROOM,), config).facts() | {"scored": True})
    run.write_metrics(metrics | {"frames": 3})
    command = ("batch", ROOM, "--out", f"{INPUT}/..", *QUICK)
    yield _sample("batch", folder / "batch", run.path, (command,), 0.3)


def _poses(folder: Path) -> Iterator[Sample]:
    """Make files with the poses of the room's three frames, in the formats whose frames have numbers or times."""
    path = open_source(ROOM).truth()
    assert path is not None
    rows = [[t, *T[:3, 3], 0, 0, 0, 1] for t, T in zip(path.timestamps_s, path.T_world_camera, strict=True)]
    texts = {"tum": rows, "kitti": path.T_world_camera[:, :3].reshape(-1, 12).tolist()}
    for name, lines in texts.items():
        place = folder / f"poses_{name}"
        layouts.save_text(place / "poses.txt", "".join(" ".join(map(str, line)) + "\n" for line in lines))
        words = ("run", ROOM, "--poses", INPUT, "--out", OUT, "--no-eval", *QUICK)
        yield _sample(place.name, place, place / "poses.txt", (words,), 0.5)
    place, colors = folder / "poses_named", layouts.plain(folder / "poses_named", layouts.sample())
    names = sorted(color.stem for color in (colors / "color").iterdir())
    images = "".join(f"{i} 1 0 0 0 {i / 50} 0 0 1 {name}.png\n1 2 -1\n" for i, name in enumerate(names))
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in names]
    layouts.save_text(colors / "images.txt", images)
    layouts.save_text(colors / "poses.json", json.dumps({"frames": frames}))
    words = ("run", INPUT, "--out", OUT, "--no-eval", *QUICK, "--poses")
    commands = tuple((*words, f"{INPUT}/{file}") for file in ("images.txt", "poses.json"))
    yield _sample("poses_named", place, colors, commands)
