"""Measure whether the viewer's memory stays constant while a run grows (issue 7).

A simulated system grows like a real one, but without its computations: frames, keyframes with images, submaps that are
written to disk, an active map that changes continuously. The callback and viewer of `sigmasplat run --view` show it to
one client in another process, whose viewpoint moves continuously; the view mode changes every 4 s. Every 15 s the
splats are shown in their colours without updates for 3 s, so that measurements are comparable. Then the resident
memory of the server's process is recorded, and the part of it in use according to glibc. Writes
benchmarks/results/viewer-memory-<machine>.json and prints tables. Linux only.

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

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.relative_pose import UNKNOWN_HOP, RelativePose
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.plugins.viewer.snapshot import field_without_moments
from sigmasplat.plugins.viewer.snapshot_sources import LiveView
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.slam.results import Step
from sigmasplat.system.slam import Slam

if TYPE_CHECKING:
    from sigmasplat.plugins.viewer.app import ViewerApp

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
    """Measure whether the viewer's memory stays constant while a run grows."""

    minutes: Annotated[float, arg(help="duration; results are written from 10 minutes")] = 10.0
    frames_per_s: Annotated[float, arg(help="frame rate of the simulated run")] = 20.0
    splats: Annotated[int, arg(help="number of splats per simulated submap")] = 60_000
    name: Annotated[str, arg(help="name of the results")] = "viewer-memory"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


class Growing:
    """A system that grows by one frame per call. All its parts are real, but nothing is fitted."""

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
        """Add a frame, regularly a keyframe, and regularly a submap."""
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
        self.slam.mapper = Mapper(self.slam.config, self.random, field_without_moments(self.field.params[:0], {}))

    def _map(self, frame: int, pose: Any) -> None:
        """Add a keyframe, move the splats and add some, as mapping does."""
        slam, grown = self.slam, int(self.splats * (0.5 + 0.5 * (frame % SUBMAP_EVERY) / SUBMAP_EVERY))
        color = self.random.random((CAMERA.height, CAMERA.width, 3), np.float32)
        seen = Frame(frame, 0.05 * frame, color, np.full((CAMERA.height, CAMERA.width), 2.0, np.float32), CAMERA)
        target = Target.of(seen, (CAMERA.height, CAMERA.width))
        slam.mapper.keyframes.append(Keyframe(frame, target, pose, not slam.mapper.keyframes))
        known = slam.atlas.keyframe_poses.last
        hop = RelativePose.hop(se3.inverse(pose) @ known[-1]) if known else UNKNOWN_HOP
        slam.atlas.set_keyframes([*known, pose], hop)
        slam.keyframe_indices.append(frame)
        self.field.params[:, :3] += 1e-3 * torch.sin(torch.tensor(frame))
        slam.mapper.field = field_without_moments(self.field.params[:grown], {})

    def _pose(self, frames: int) -> Any:
        """Return the camera's pose after `frames` frames of a submap."""
        return se3.exp(np.array([0.01 * frames, 0.0, 0.0, 0.0, 0.002 * frames, 0.0]))


def resident_mib() -> float:
    """Return the resident memory of this process in MiB."""
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


class Counts(ctypes.Structure):
    """glibc's heap statistics in bytes (mallinfo2, malloc.h); uordblks and hblkhd are in use."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks")),
        *((name, ctypes.c_size_t) for name in ("fsmblks", "uordblks", "fordblks", "keepcost")),
    ]


def in_use_mib() -> float:
    """Return the allocated memory of this process in MiB; the rest of the resident memory is code and free blocks."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = Counts
    counts = mallinfo2()
    return float(counts.uordblks + counts.hblkhd) / 2**20


def measure(options: Options) -> dict[str, Any]:
    """Show the growing system for the given time; return the figures."""
    from sigmasplat.plugins.viewer.app import ViewerApp
    from sigmasplat.plugins.viewer.server import HOST, close, open_server

    server = open_server(HOST, 8780, "viewer memory")
    viewer = ViewerApp(server)
    command = [sys.executable, "-c", CLIENT, f"ws://{HOST}:{server.get_port()}"]
    client = subprocess.Popen(command)
    try:
        with TemporaryDirectory(prefix="viewer-memory-") as folder:
            growing = Growing(Path(folder) / "submaps", options.splats)
            return watch(growing, viewer, options) | {"client_gone": client.poll() is not None}
    finally:
        client.kill()
        client.wait()
        viewer.stop()
        close(server)


def watch(growing: Growing, viewer: "ViewerApp", options: Options) -> dict[str, Any]:
    """Run the system and sample the memory; return the figures."""
    from sigmasplat.plugins.viewer.layers import MODES

    shown = 0

    def show(snapshot: Any) -> None:
        nonlocal shown
        shown += 1
        viewer.show(snapshot)

    live, begun_s = LiveView(growing.slam, show, "growing"), time.monotonic()
    samples: list[dict[str, float]] = []
    while (now_s := time.monotonic() - begun_s) < 60.0 * options.minutes:
        live(growing())
        if now_s >= SAMPLE_S * (len(samples) + 1):
            viewer.panel.mode.value, viewer.panel.colouring.value = MODES["splats"], "their own"
            show(live.snapshot())
            time.sleep(REST_S)
            memory = {"resident_mib": resident_mib(), "in_use_mib": in_use_mib()}
            samples.append({"s": now_s, **memory, "clients": len(viewer.server.get_clients())})
        viewer.panel.mode.value = [*MODES.values()][int(now_s / CHANGE_S) % len(MODES)]
        viewer.panel.colouring.value = ("their own", "how unsure")[int(now_s / CHANGE_S / len(MODES)) % 2]
        time.sleep(max(0.0, growing.frames / options.frames_per_s - (time.monotonic() - begun_s)))
    return {
        "minutes": options.minutes, "frames": growing.frames, "keyframes": len(growing.slam.keyframe_indices),
        "submaps": len(growing.slam.store), "updates": shown, "samples": samples,
    }  # fmt: skip


# ---- tables ----


MINUTES, LARGER = 10.0, 0.05
"""Issue 7: constant over ten minutes of live updates."""


def fifths(samples: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return for each fifth of the samples its end in s and its memory in MiB."""
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
        ["minimum number of clients", f"{clients:.0f}", "≥ 1", _yes(clients >= 1)],
    ]
    return [
        Section("Memory", ["until", "median, MiB", "maximum, MiB", "in use, MiB", "minimum clients"], rows, note),
        Section("Goals", ["", "measured", "goal", "met"], held),
    ]


def _yes(held: bool) -> str:
    return "yes" if held else "**no**"


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("viewer_memory", options, measure, write=options.minutes >= MINUTES)


if __name__ == "__main__":
    program.start(main, Options)
