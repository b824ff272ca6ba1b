"""The last stage of the final map: finer than the working images, deterministic, and it can be stopped."""

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from command_line import exit_code
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.final import full_resolution
from sigmasplat.final.final_map import final_map
from sigmasplat.fit.adam import Rates
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from sigmasplat.types import Matrix

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

ROOM = "synthetic:frames=120,width=160,height=120,noise=1"
SETTINGS = {
    "input.width": "80", "input.limit": "24", "mapping.first_iterations": "30", "mapping.iterations": "8",
    "mapping.every": "3", "submaps.frames": "12", "final.iterations": "60", "registration.iterations": "2",
    "final.width": "8192",
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


def held_out_psnr(
    slam: Slam, config: Config, render: Callable[[Camera, Matrix], NDArray[np.float32]], width: int
) -> float:
    """Return the mean PSNR, dB, of images of frames that no map was fitted to; render: colour [H, W, 3] from a pose."""
    found = []
    for frame in open_source(ROOM, config.input):
        if frame.index not in slam.keyframe_indices:
            small = frame.prepared(width, 0.1, 8.0)
            image = render(small.camera, se3.inverse(slam.trajectory().T_world_camera[frame.index]))
            found.append(psnr(image.clip(0.0, 1.0), small.color, small.depth_m > 0))
    return float(np.mean(found))


@pytest.mark.slow
def test_the_last_stage_is_sharper_at_both_sizes(slam: Slam) -> None:
    """Held-out frames at the size of the recording, where it also beats an enlarged image of the map before, and at
    working size, where the map needs the low-pass of the photos."""
    scores = dict[tuple[str, str], float]()
    for name, width in (("before", "0"), ("after", "8192")):
        config = settings(iterations="400", width=width)
        made = final_map(slam.store, slam.atlas.anchors, config, slam.view, np.random.default_rng(0))
        refined = FieldRenderer(config.render, config.backend, (made.field, made.refined_fx))
        plain = FieldRenderer(config.render, config.backend)

        def image(camera: Camera, T: Matrix, of=refined, field=made.field) -> NDArray[np.float32]:
            return of(field, camera, T).color.numpy()

        def enlarged(camera: Camera, T: Matrix, image=image) -> NDArray[np.float32]:
            size = camera.width, camera.height
            return np.asarray(cv2.resize(image(camera.prepared(80), T), size, interpolation=cv2.INTER_CUBIC))

        scores[name, "large"] = held_out_psnr(slam, config, image, 160)
        scores[name, "enlarged"] = held_out_psnr(slam, config, enlarged, 160)
        scores[name, "working"] = held_out_psnr(slam, config, image, 80)
        scores[name, "plain"] = held_out_psnr(slam, config, partial(image, of=plain), 80)
    assert scores["after", "large"] > scores["before", "enlarged"] + 1.0
    assert scores["after", "large"] > scores["before", "large"] + 1.0
    assert scores["after", "working"] > scores["before", "working"]
    assert scores["before", "plain"] == scores["before", "working"]  # nothing was refined on photos
    assert scores["after", "plain"] < scores["after", "working"] - 0.5


def test_keyframes_keep_photos_only_for_the_last_stage(slam: Slam) -> None:
    photo = slam.store.picture(0, 0).photo
    assert photo is not None and photo.camera.width == 160
    config = settings(width="0")
    plain, source = Slam(config), open_source(ROOM, config.input)
    plain.step(source.frame(0))
    plain.finish()
    assert plain.store.picture(0, 0).photo is None


def test_the_progress_covers_the_last_stage() -> None:
    config = settings(iterations="30")
    slam, told = Slam(config), list[tuple[int, int]]()
    slam.step(open_source(ROOM, config.input).frame(0))
    slam.finish(lambda done, total: told.append((done, total)))
    dones, totals = zip(*told, strict=True)
    assert list(dones) == sorted(dones) and set(totals) == {dones[-1]} and dones[-1] >= 60


def test_a_time_budget_covers_both_stages(slam: Slam, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the clock takes a hundredth of a second. The stage at working size gets a third of the budget, the
    last one the rest, whatever the number of steps, and its rates fall in time."""
    ticks = itertools.count(0.0, 0.01)
    monkeypatch.setattr("sigmasplat.final.refinement.time.perf_counter", lambda: next(ticks))
    config = settings(iterations="50", seconds="12.0")
    told, rates = list[tuple[int, int]](), list[float]()
    fit = full_resolution.fit_field

    def noted(*of: Any, **named: Any) -> Any:
        *plain, schedule = of
        each = [made.per_column.clone() for made in schedule]
        rates.extend(float(made[0]) / config.mapping.lr_means for made in each)
        return fit(*plain, iter(Rates(per_column) for per_column in each), **named)

    monkeypatch.setattr("sigmasplat.final.full_resolution.fit_field", noted)
    made = final_map(
        slam.store, slam.atlas.anchors, config, slam.view, np.random.default_rng(0), lambda *at: told.append(at)
    )
    assert made.refined_fx is not None and made.steps > 2 * 50
    assert rates[0] == pytest.approx(4.0, rel=0.1) and rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(0.4, rel=0.1)
    dones = [done for done, _ in told]
    assert dones == sorted(dones) and told[-1] == (100, 100)


def arguments(out: Path) -> list[str]:
    long = SETTINGS | {"final.iterations": "600"}  # so that there is time to kill it
    changed = [word for key, value in long.items() for word in ("--set", f"{key}={value}")]
    return ["run", ROOM, "--out", str(out), "--no-eval", "--save-every", "0.001", *changed]


@pytest.mark.slow
def test_a_run_killed_in_its_final_map_gives_the_same_bytes(tmp_path: Path) -> None:
    assert exit_code(*arguments(tmp_path / "whole")) == 0
    run = RunFolder(tmp_path / "cut")
    command = [sys.executable, "-m", "sigmasplat.cli", *arguments(run.path)]
    process, deadline_s = subprocess.Popen(command, env=os.environ, stdout=subprocess.DEVNULL), time.monotonic() + 300
    log = run.path / "log.jsonl"
    while not log.exists() or log.read_text().count("\n") < int(SETTINGS["input.limit"]):
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
