"""Say that a run failed, or that its scale is wrong: what is known of the cause, and the commands to try next."""

import shlex
from collections import Counter
from typing import Any

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import RunFolder, Source, Trajectory
from sigmasplat.plugins.evaluation.metrics.trajectory import absolute_error, align_similarity, pair_poses

MOST_LOST = 1.0 / 3.0
CAUSES = {
    "no texture": "the images have no texture (black, white or blank)",
    "correlates": "colour does not fit where depth and camera put it (unit, focal length, registration, fast motion)",
    "seen through": "depth of one image contradicts that of another (unit, registration, moving objects)",
    "off from": "the view changes faster than expected (frames are missing, or the camera moves too fast)",
    "in common": "the images have next to nothing in common (frames are missing, or the view jumps)",
    "": "depth and map disagree, or too little depth is within the limits of the run",
}
"""What the judge of poses says of a lost frame (`pose_validation.diagnosis`), by a part of its words."""
WRONG_SCALE, FITTED, FEWEST = 0.05, 0.1, 10
"""A scale is wrong if it differs more from 1; errors then left, by the extent of the path; poses that determine it."""


def failure(run: RunFolder, source: Source) -> dict[str, list[str]]:
    """Return why a run failed, and commands to try; nothing if two thirds of its frames have a pose, none apart."""
    frames, config, facts = run.read_frames(), run.config(), run.facts()
    without = sorted([*frames.indices(api.LOST), *(apart := frames.indices(api.APART))])
    if not apart and len(without) <= MOST_LOST * len(frames):
        return {}
    pieces = f"; {len(apart)} of them are in other pieces of it (components/)" * bool(apart)
    said = [f"{len(without)} of {len(frames)} images have no pose in the map ({api.format_ranges(without)}){pieces}"]
    why = [record.get("diagnosis", "") for record in frames.log if record.get("lost")]
    causes = Counter(next(cause for part, cause in CAUSES.items() if part in words) for words in why)
    said += [f"Likely cause: {cause}, in {count} images" for cause, count in causes.most_common(1)]
    said += filter(None, [api.depth_warning(source)])
    said += [f"Assumed: {'; '.join(source.assumptions)}"] * bool(source.assumptions)
    commands = [rerun_command(config, facts, "inspect")]
    if source.path_by and not config.input.poses:
        commands.append(f"{rerun_command(config, facts)} --poses recorded")
    return {f"FAILED: {'. '.join(said)}.": commands}


def scale_to_truth(path: Trajectory, truth: Trajectory) -> float | None:
    """Return the factor that brings a path to the scale of the truth, None if both do not determine it."""
    ours, theirs = (poses[:, :3, 3] for poses in pair_poses(path, truth))
    scale, _ = align_similarity(ours, theirs)
    fitted = absolute_error(scale * ours, theirs).rmse_m <= FITTED * np.linalg.norm(theirs.std(0))
    return scale if fitted and scale > 0.0 and len(ours) >= FEWEST else None


def wrong_scale(run: RunFolder, source: Source, scale: float | None) -> dict[str, list[str]]:
    """Return what is wrong if `scale_to_truth` differs from 1 by more than 5 %, and commands to try."""
    if not scale or abs(scale - 1.0) <= WRONG_SCALE:
        return {}
    times, config, units = max(scale, 1.0 / scale), run.config(), source.depth_units_per_metre
    said = f"WRONG SCALE: the path is {times:.{1 + (times < 1.5)}f} times too {'small' if scale > 1.0 else 'large'}"
    if not units or config.input.poses:
        return {said: []}
    usual = next((u for u in api.KNOWN_UNITS_PER_METRE if abs(u * scale / units - 1.0) < WRONG_SCALE), None)
    what = "the depth unit" if usual else "depth or the focal length"
    remedy = f"--depth-scale {usual or float(f'{units / scale:.2g}'):g}"
    origin = source.origins.get("depth unit")
    said += f": {what} is probably wrong ({origin.origin if origin else 'now'} {units:g} per metre; {remedy})"
    return {said: [f"{rerun_command(config, run.facts())} {remedy}"]}


def rerun_command(config: api.Config, facts: dict[str, Any], command: str = "run") -> str:
    """Return the command that makes the run again, or inspects its recording: its preset, and what differs from it."""
    words, of_run = ["sigmasplat", command, str(facts.get("source_path") or "PATH")], command == "run"
    if of_run and (onto := facts.get("onto")):
        words += ["--onto", str(onto["run"])]
    pairs = api.differences(config, api.preset(config.name)) if api.is_preset(config.name) else []
    if of_run and config.name != api.default_preset() and api.is_preset(config.name):
        words += ["--preset", config.name]
    return shlex.join([*words, *(w for p in pairs if of_run or p.startswith("input.") for w in ("--set", p))])
