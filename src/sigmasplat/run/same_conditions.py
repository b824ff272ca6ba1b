"""Compare the sequence of a resumed run with the one it was started with."""

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from sigmasplat import env
from sigmasplat.errors import RunError
from sigmasplat.input.source import Source
from sigmasplat.run.scene import scene_facts
from sigmasplat.run_folder.frames import SAME_TIME_S
from sigmasplat.run_folder.runs import RunFolder

SAME_SHARE = 1e-6
"""Numbers of a calibration that differ by less are equal: a recording has them as text."""


def start_facts(source: Source) -> dict[str, Any]:
    """Return what run.json keeps: the sequence, to recognise it on resume, its scene, the origin of its values, and the
    kernels' instruction set.

    A live camera is compared by its image size and intrinsics alone: its recording has its own depth unit.
    """
    facts: dict[str, Any] = {"camera": asdict(source.camera), "isa": instruction_set()}
    if not source.live:
        facts |= {"source_frames": len(source), "depth_units_per_metre": source.depth_units_per_metre}
    return facts | {"origins": {name: o._asdict() for name, o in source.origins.items()}} | scene_facts(source)


def refuse_other_sequence(run: RunFolder, source: Source) -> None:
    """Raise RunError, with the first difference, unless a source has the camera and the frames of a run's start."""
    if difference := next(_differences(run, source), ""):
        raise RunError(
            f"{run.path} cannot be resumed, because its sequence has changed: {difference}; give the original one "
            "(--source PATH), or start again with: sigmasplat run"
        )


def _differences(run: RunFolder, source: Source) -> Iterator[str]:
    """Yield in what a source differs from that of a run: camera, depth unit, times of the logged frames, length."""
    facts, found = run.facts(), start_facts(source)
    units = {name: facts[name] for name in ("depth_units_per_metre",) if name in facts}
    for name, value in ({**(facts.get("camera") or {})} | units).items():
        now = (found | found["camera"]).get(name)
        if not _same(value, now):
            yield f"{name} is {_text(now)}, it was {_text(value)}"
    for record in run.read_log() if (run.path / "log.jsonl").is_file() else ():
        index, time_s = record["index"], record["timestamp_s"]
        if index >= len(source):
            yield f"it has {len(source)} frames, but frame {index} was already processed"
        elif abs(source.timestamp_s(index) - time_s) > SAME_TIME_S:
            yield f"frame {index} is of {source.timestamp_s(index):.6f} s, it was of {time_s:.6f} s"
    if (noted := facts.get("source_frames", len(source))) != len(source):
        yield f"it has {len(source)} frames, it had {noted}"


def _same(noted: Any, found: Any) -> bool:
    if isinstance(noted, int | float) and isinstance(found, int | float):
        return math.isclose(noted, found, rel_tol=SAME_SHARE, abs_tol=SAME_SHARE)
    return bool(noted == found)


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def instruction_set() -> str:
    """Return the instruction set of the kernels."""
    from sigmasplat.native import _core

    asked = env.switches().isa
    return _core.isa_name() if asked == "auto" else asked
