"""Frames of a sensor that reads late, whose times are known: each is fitted again, and mapped, after the next one."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from late_images import film, path
from schedules import AtOnce, Drawn
from sigmasplat.config.find_preset import configured
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import MemoryStore
from sigmasplat.realtime.system import RealTime
from sigmasplat.run.resume import CLASSES, fixed, restore, state_of
from sigmasplat.run_folder.state import read_state, write_state
from sigmasplat.system.array_interface import Correction
from sigmasplat.system.slam import Slam

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
TIMES_S, FRAMES = (-0.015, 0.025, 0.03), 36
KNOWN = f"{TIMES_S[0]},{TIMES_S[1]},{TIMES_S[2]},0.001,0.001,0.001"
QUICK = {
    "input.width": 160, "mapping.first_iterations": 8, "mapping.iterations": 4, "final.iterations": 0,
    "uncertainty.probes": 0, "seeding.max_splats": 3000, "input.hold_every": 0,
}  # fmt: skip


@cache
def seen() -> list[Frame]:
    return list(film(FRAMES, TIMES_S))


def slam(times: str = KNOWN, **more: object) -> Slam:
    changes = {name.replace("__", "."): value for name, value in more.items()}
    return Slam(configured("sigma", QUICK | changes | {"input.calibrate": times}), MemoryStore())


def ran(system: Slam | RealTime, frames: Sequence[Frame]) -> Slam | RealTime:
    for frame in frames:
        system.step(frame)
    system.finish()
    return system


def errors_mm(T_world_camera: Array) -> tuple[float, float]:
    """Return the errors of position and of rotation (at 1 m), mm, rms, relative to the first frame."""
    truth = path(np.arange(len(T_world_camera)) / 30)
    apart = se3.inverse(se3.inverse(truth[0]) @ truth) @ T_world_camera
    turned = se3.log_stack(apart)[:, 3:]
    return tuple(1e3 * float(np.sqrt((part**2).sum(1).mean())) for part in (apart[:, :3, 3], turned))  # type: ignore


def test_the_path_is_that_of_the_middle_of_the_colour() -> None:
    """Depth is 15 ms early: a hand at 0.3 m/s and 0.4 rad/s is some millimetres away then."""
    unknown, known = (errors_mm(ran(slam(times), seen()).trajectory().T_world_camera) for times in ("off", KNOWN))
    assert max(known) < 1.0, known
    assert min(unknown) > 2.5 * max(known), (unknown, known)


def test_a_pose_is_better_when_the_next_frame_is_known() -> None:
    """The pose of the newest frame, and what becomes of it."""
    system, at_first = slam(), []
    for frame in seen():
        system.step(frame)
        at_first.append(system.trajectory().T_world_camera[-1])
    later = system.trajectory().T_world_camera
    assert sum(errors_mm(later)) < 0.8 * sum(errors_mm(np.stack(at_first)))


def test_a_keyframe_is_mapped_with_the_next_frame_or_at_the_end() -> None:
    system, waited = slam(), 0
    for frame in seen():
        step = system.step(frame)
        last = system.mapper.keyframes[-1].index
        waited += step.is_keyframe and last < step.index
        assert step.is_keyframe or system.late is None or not system.late.mapped
    assert waited > 3
    number = sum(step.is_keyframe for step in system.steps)
    cut, found = slam(), list[Correction]()
    cut.on_correction(found.append)
    for frame in seen():  # ends at a keyframe that waits
        if cut.step(frame).is_keyframe and len(cut.steps) > 10:
            break
    assert cut.late is not None and cut.late.mapped
    cut.finish()
    assert cut.late is None and cut.keyframe_indices[-1] == len(cut.steps) - 1
    assert found[-1].reason == "final map" and found[-1].frames.max() < len(cut.steps) - 1
    assert len(system.keyframe_indices) + (system.late is not None and system.late.mapped) == number


@pytest.mark.parametrize("more", [1, 2])
def test_a_resumed_run_gives_the_same_bytes_while_a_frame_waits(more: int, tmp_path: Path) -> None:
    """Saved after a keyframe that waits, and after the frame behind it."""
    system = slam()
    for number, frame in enumerate(seen()):
        if system.step(frame).is_keyframe and number > 10:
            break
    for frame in seen()[number + 1 : number + more]:
        system.step(frame)
    done, file = len(system.steps), tmp_path / "state"
    write_state(file, state_of(system), CLASSES, fixed(system))
    again = slam()
    again.prepare(seen()[0].camera.prepared(160, 0))
    restore(again, read_state(file, CLASSES, fixed(again)))
    assert again.late is not None and again.late.mapped == (more == 1)
    first, second = (ran(each, seen()[done:]) for each in (system, again))
    assert first.trajectory().T_world_camera.tobytes() == second.trajectory().T_world_camera.tobytes()
    assert first.field.params.numpy().tobytes() == second.field.params.numpy().tobytes()


@pytest.mark.parametrize("schedule", [AtOnce(), Drawn(0), Drawn(1)], ids=["at-once", "drawn-0", "drawn-1"])
def test_in_real_time_frames_wait_as_well(schedule: AtOnce) -> None:
    system = ran(RealTime(slam(), schedule), seen())
    path_found = system.trajectory()
    assert len(path_found) == FRAMES and system.valid().all()
    assert max(errors_mm(path_found.T_world_camera)) < 1.5


def test_a_keyframe_before_a_lost_frame_is_mapped_with_what_is_known() -> None:
    black = [replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m)) for frame in seen()]
    system = slam()
    for number, frame in enumerate(seen()):
        if system.step(frame).is_keyframe and number > 10:
            break
    system.step(black[number + 1])
    assert system.late is None and system.keyframe_indices[-1] == number
    for frame in seen()[number + 2 :]:
        system.step(frame)
    found = system.valid()
    assert not found[number + 1] and found.sum() >= FRAMES - 3
    assert max(errors_mm(system.trajectory().T_world_camera[: number + 1])) < 1.0
