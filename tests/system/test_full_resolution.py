"""The last stage of the final map: finer than the working images, deterministic, and it can be stopped."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code
from sigmasplat.config import Config
from sigmasplat.config.text import override
from sigmasplat.io.runs import RunFolder
from sigmasplat.io.state import read_state
from sigmasplat.metrics.image import psnr
from sigmasplat.model import se3
from sigmasplat.presets import preset
from sigmasplat.render import FieldRenderer
from sigmasplat.run.resume import REFINEMENT_CLASSES
from sigmasplat.slam.final import final_map
from sigmasplat.slam.slam import Slam
from sigmasplat.sources import open_source

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=120,width=160,height=120,noise=1"
SETTINGS = {
    "input.width": "80", "input.limit": "24", "mapping.first_iterations": "30", "mapping.iterations": "8",
    "mapping.every": "3", "submaps.frames": "12", "final.iterations": "60", "registration.iterations": "2",
    "final.width": "camera", "final.width_iterations": "100",
}  # fmt: skip
SAME = ("trajectory.txt", "map.ply", "checkpoint.safetensors")


def settings(**more: str) -> Config:
    return override(preset("sigma"), SETTINGS | {f"final.{name}": value for name, value in more.items()})


@pytest.fixture(scope="module")
def slam() -> Slam:
    """Return a run of all frames, without a final map."""
    config = settings()
    slam = Slam(config)
    for frame in open_source(ROOM, config.input):
        slam.step(frame)
    slam.finish()
    return slam


def test_the_last_stage_is_sharper_than_an_upsampled_map(slam: Slam) -> None:
    """Held-out frames at the size of the recording, and at working size."""
    scores = {}
    for steps in ("0", "600"):
        config = settings(iterations="200", width_iterations=steps)
        field = final_map(slam.store, slam.atlas.anchors, config, slam.view, np.random.default_rng(0)).field
        render = FieldRenderer(config.render, config.backend)
        for width in (160, 80):
            found = []
            for frame in open_source(ROOM, config.input):
                if frame.index not in slam.keyframe_indices:
                    small = frame.prepared(width, 0.1, 8.0)
                    T_camera_world = se3.inverse(slam.trajectory().T_world_camera[frame.index])
                    image = render(field, small.camera, T_camera_world).color.clamp(0.0, 1.0).numpy()
                    found.append(psnr(image, small.color, small.depth_m > 0))
            scores[steps, width] = float(np.mean(found))
    assert scores["600", 160] > scores["0", 160] + 0.5
    assert scores["600", 80] > scores["0", 80]


def test_keyframes_keep_photos_only_for_the_last_stage(slam: Slam) -> None:
    photo = slam.store.picture(0, 0).photo
    assert photo is not None and photo.camera.width == 160
    config = settings(width="working")
    plain, source = Slam(config), open_source(ROOM, config.input)
    plain.step(source.frame(0))
    plain.finish()
    assert plain.store.picture(0, 0).photo is None


def test_the_progress_covers_the_last_stage() -> None:
    config = settings(iterations="5", width_iterations="60")
    slam, told = Slam(config), list[tuple[int, int]]()
    slam.step(open_source(ROOM, config.input).frame(0))
    slam.finish(lambda done, total: told.append((done, total)))
    dones, totals = zip(*told, strict=True)
    assert list(dones) == sorted(dones) and set(totals) == {dones[-1]} and dones[-1] >= 65


def arguments(out: Path) -> list[str]:
    long = SETTINGS | {"final.width_iterations": "1000"}  # so that there is time to kill it
    changed = [word for key, value in long.items() for word in ("--set", f"{key}={value}")]
    return ["run", ROOM, "--out", str(out), "--no-eval", "--save-every", "0.001", *changed]


def steps_saved(run: RunFolder, tmp_path: Path) -> int:
    """Return the steps of the saved refinement of a run in progress. A copy is read: the run replaces its file, and
    safetensors opens a file twice."""
    copy = shutil.copyfile(run.refinement, tmp_path / "copy.safetensors")
    done: int = read_state(copy, REFINEMENT_CLASSES, {})["refined"].done
    return done


def test_a_run_killed_in_the_last_stage_gives_the_same_bytes(tmp_path: Path) -> None:
    assert exit_code(*arguments(tmp_path / "whole")) == 0
    run = RunFolder(tmp_path / "cut")
    command = [sys.executable, "-m", "sigmasplat.cli", *arguments(run.path)]
    process, deadline_s = subprocess.Popen(command, env=os.environ, stdout=subprocess.DEVNULL), time.monotonic() + 300
    while not run.refinement.exists() or steps_saved(run, tmp_path) <= 60:
        assert process.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (run.path / "map.ply").exists()
    assert exit_code("resume", str(run.path), "--no-eval") == 0
    for file in SAME:
        assert (run.path / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file
    photo = run.submaps.picture(0, 0).photo
    assert photo is not None and photo.camera.width == 160
