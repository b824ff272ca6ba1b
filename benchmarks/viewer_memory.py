"""Watch a run grow in the browser for a while, and ask whether the viewer's memory grows with it (issue 7).

A system is made up that grows as a real one does, without its work: frames, keyframes with pictures, submaps that are
finished to disk, an active map that changes all the time. It is shown through the very watcher and stage of `sigmasplat
run --view`, to one client in another process, which looks from ever new places; what is shown is changed every 4 s.
Kept is the resident memory of the server's process at rest: every 15 s splats are shown in their colours and nothing
new comes for 3 s, so that like is compared with like; and how much of it is in use, by glibc's own count. Writes
benchmarks/results/viewer-memory-<machine>.json, prints tables. Linux only.

example: python benchmarks/viewer_memory.py --minutes 1
"""

import ctypes
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import program
import record
import torch
import tyro
from tables import Section, significant

from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.io.submaps import DiskStore
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.slam.mapper import Mapper
from sigmasplat.slam.slam import Slam
from sigmasplat.slam.step_result import Step
from sigmasplat.viewer.live import LiveView
from sigmasplat.viewer.snapshot import to_look_at

if TYPE_CHECKING:
    from sigmasplat.viewer.app import Stage

arg = tyro.conf.arg
STATM = Path("/proc/self/statm")
CAMERA = Camera(160, 120, 131.0, 131.0, 79.5, 59.5)
KEYFRAME_EVERY, SUBMAP_EVERY, CHANGE_S, SAMPLE_S, REST_S = 5, 200, 4.0, 15.0, 3.0
CLIENT = """
import itertools, math, sys, time
import msgspec, viser
from websockets.sync.client import connect
with connect(sys.argv[1], max_size=None, subprotocols=["viser-v" + viser.__version__]) as socket:
    for i in itertools.count():
        x = 0.3 * math.sin(0.1 * i)
        look = dict(type="ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(x, 0.0, -1.0), fov=1.0,
                    near=0.01, far=1000.0, image_height=720, image_width=1280, look_at=(x, 0.0, 0.0),
                    up_direction=(0.0, -1.0, 0.0))
        socket.send(msgspec.msgpack.encode(look))
        until_s = time.monotonic() + 0.5
        while (left_s := until_s - time.monotonic()) > 0:
            try:
                socket.recv(timeout=left_s)
            except TimeoutError:
                pass
"""


@dataclass(frozen=True)
class Options:
    """Watch a run grow in the browser for a while, and ask whether the viewer's memory grows with it."""

    minutes: Annotated[float, arg(help="how long, at least 10 for a result")] = 10.0
    frames_per_s: Annotated[float, arg(help="speed of the run that is made up")] = 20.0
    splats: Annotated[int, arg(help="splats of each of its submaps")] = 60_000
    name: Annotated[str, arg(help="name of the results")] = "viewer-memory"
    out: Annotated[Path, arg(help="folder of the results; nothing is written below 10 minutes")] = record.RESULTS


class Growing:
    """A system that grows by a frame at each call, every part of it real but the fits."""

    def __init__(self, folder: Path, splats: int) -> None:
        self.slam, self.splats = Slam(store=DiskStore(folder)), splats
        self.random = np.random.default_rng(0)
        self.frames = 0
        random = torch.from_numpy(self.random.random((splats, 9), np.float32))
        means = torch.cat([4.0 * random[:, :2] - 2.0, 2.0 + random[:, 2:3]], 1)
        scales, log_variances = 0.005 + 0.02 * random[:, 3:6], -9.0 + 6.0 * random[:, 6:9]
        self.field = GaussianField.from_values(
            means, scales, random[:, 6:9], opacities=0.9, log_variances=log_variances
        )
        self.slam.atlas.begin_submap()
        self._begin()

    def __call__(self) -> Step:
        """Add a frame; at times a keyframe, at times a submap."""
        slam, frame = self.slam, self.frames
        if frame and frame % SUBMAP_EVERY == 0:
            slam.store.save(*slam.mapper.finished(len(slam.store)))
            slam.atlas.begin_submap(self._pose(SUBMAP_EVERY))
            self._begin()
        pose = self._pose(frame % SUBMAP_EVERY)
        is_keyframe = frame % KEYFRAME_EVERY == 0
        if is_keyframe:
            self._map(frame, pose)
        slam.atlas.place_frame(pose)
        self.frames += 1
        T_world_camera, lost = slam.atlas.anchors[-1] @ pose, frame % 97 == 0
        submap = len(slam.atlas.anchors) - 1
        step = Step(frame, 0.05 * frame, T_world_camera, is_keyframe, lost, {}, len(slam.mapper.field), submap)
        slam.steps.append(step)
        return step

    def _begin(self) -> None:
        self.slam.mapper = Mapper(self.slam.config, self.random, to_look_at(self.field.params[:0], {}))

    def _map(self, frame: int, pose: Any) -> None:
        """Take note of a keyframe; move the splats, and show more of them, as mapping would."""
        slam, grown = self.slam, int(self.splats * (0.5 + 0.5 * (frame % SUBMAP_EVERY) / SUBMAP_EVERY))
        color = self.random.random((CAMERA.height, CAMERA.width, 3), np.float32)
        seen = Frame(frame, 0.05 * frame, color, np.full((CAMERA.height, CAMERA.width), 2.0, np.float32), CAMERA)
        target = Target.of(seen, (CAMERA.height, CAMERA.width))
        slam.mapper.keyframes.append(Keyframe(frame, target, pose, not slam.mapper.keyframes))
        slam.atlas.keyframes[-1].append(pose)
        slam.keyframes.append(frame)
        self.field.params[:, :3] += 1e-3 * torch.sin(torch.tensor(frame))
        slam.mapper.field = to_look_at(self.field.params[:grown], {})

    def _pose(self, frames: int) -> Any:
        """Return where the camera is after so many frames of a submap."""
        return se3.exp(np.array([0.01 * frames, 0.0, 0.0, 0.0, 0.002 * frames, 0.0]))


def resident_mib() -> float:
    """Return the resident memory of this process."""
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


class Counts(ctypes.Structure):
    """What glibc counts of its heap (mallinfo2, malloc.h), bytes; uordblks and hblkhd are in use."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks")),
        *((name, ctypes.c_size_t) for name in ("fsmblks", "uordblks", "fordblks", "keepcost")),
    ]


def in_use_mib() -> float:
    """Return the memory that is allocated in this process; the rest of the resident one is code and holes."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = Counts
    counts = mallinfo2()
    return float(counts.uordblks + counts.hblkhd) / 2**20


def measure(options: Options) -> dict[str, Any]:
    """Show the growing system for as long as asked; return the figures."""
    from sigmasplat.viewer.app import Stage
    from sigmasplat.viewer.server import HOST, close, open_server

    server = open_server(HOST, 8780, "viewer memory")
    stage = Stage(server)
    command = [sys.executable, "-c", CLIENT, f"ws://{HOST}:{server.get_port()}"]
    client = subprocess.Popen(command)
    try:
        with TemporaryDirectory(prefix="viewer-memory-") as folder:
            growing = Growing(Path(folder) / "submaps", options.splats)
            return watch(growing, stage, options) | {"client_gone": client.poll() is not None}
    finally:
        client.kill()
        client.wait()
        stage.stop()
        close(server)


def watch(growing: Growing, stage: "Stage", options: Options) -> dict[str, Any]:
    """Step, and sample the memory; return what was found."""
    from sigmasplat.viewer.panel import KINDS, SAYS

    shown = 0

    def show(moment: Any) -> None:
        nonlocal shown
        shown += 1
        stage.show(moment)

    live, begun_s = LiveView(growing.slam, show, "growing"), time.monotonic()
    samples: list[dict[str, float]] = []
    while (now_s := time.monotonic() - begun_s) < 60.0 * options.minutes:
        live(growing())
        if now_s >= SAMPLE_S * (len(samples) + 1):
            stage.panel.kind.value, stage.panel.colouring.value = SAYS["splats"], "colour"
            show(live.moment())
            time.sleep(REST_S)
            memory = {"resident_mib": resident_mib(), "in_use_mib": in_use_mib()}
            samples.append({"s": now_s, **memory, "clients": len(stage.server.get_clients())})
        stage.panel.kind.value = SAYS[KINDS[int(now_s / CHANGE_S) % len(KINDS)]]
        stage.panel.colouring.value = ("colour", "σ")[int(now_s / CHANGE_S / len(KINDS)) % 2]
        time.sleep(max(0.0, growing.frames / options.frames_per_s - (time.monotonic() - begun_s)))
    return {
        "minutes": options.minutes, "frames": growing.frames, "keyframes": len(growing.slam.keyframes),
        "submaps": len(growing.slam.store), "updates": shown, "samples": samples,
    }  # fmt: skip


# ---- tables ----


MINUTES, LARGER = 10.0, 0.05
"""Issue 7: flat over ten minutes of live updates."""


def fifths(samples: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return of each fifth of the samples when it ended, s, and its resident memory, MiB."""
    parts = [part for part in np.array_split(np.arange(len(samples)), 5) if len(part)]
    return [
        {
            "until_s": samples[part[-1]]["s"],
            "median_mib": float(np.median([samples[i]["resident_mib"] for i in part])),
            "most_mib": max(samples[i]["resident_mib"] for i in part),
            "in_use_mib": float(np.median([samples[i]["in_use_mib"] for i in part])),
            "clients": min(samples[i]["clients"] for i in part),
        }
        for part in parts
    ]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by viewer_memory.py."""
    figures = measured["figures"]
    parts = fifths(figures["samples"])
    rows = [
        [
            f"{p['until_s']:.0f} s",
            *(significant(p[f"{n}_mib"]) for n in ("median", "most", "in_use")),
            f"{p['clients']:.0f}",
        ]
        for p in parts
    ]
    note = (
        f"{figures['updates']} updates of a run of {figures['frames']} frames, {figures['keyframes']} keyframes, "
        f"{figures['submaps']} submaps."
    )
    second, last = parts[min(1, len(parts) - 1)], parts[-1]
    kinds = {"resident memory": "median_mib", "memory in use": "in_use_mib"}
    ratios = {name: last[kind] / second[kind] for name, kind in kinds.items()}
    clients = min(p["clients"] for p in parts[1:] or parts)
    held = [
        ["minutes", significant(figures["minutes"]), f"≥ {MINUTES:.0f}", _yes(figures["minutes"] >= MINUTES)],
        *(
            [f"{name}, last fifth / second", significant(ratio, 4), f"≤ {1 + LARGER:.2f}", _yes(ratio <= 1 + LARGER)]
            for name, ratio in ratios.items()
        ),
        ["clients, least", f"{clients:.0f}", "≥ 1", _yes(clients >= 1)],
    ]
    return [
        Section("Memory", ["until", "MiB, median", "… most", "in use, median", "clients, least"], rows, note),
        Section("Goals", ["", "found", "goal", "held"], held),
    ]


def _yes(held: bool) -> str:
    return "yes" if held else "**no**"


def main(options: Options) -> int:
    """Measure, write, print; return the exit code."""
    return program.run("viewer_memory", options, measure, write=options.minutes >= MINUTES)


if __name__ == "__main__":
    program.start(main, Options)
