"""Score the run folder of any version for board.py: path, its covariance, lost and silent frames, views in submaps."""

import dataclasses
import json
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data import se3
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.image import depth_l1, psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import associate, ate
from sigmasplat.plugins.evaluation.path_scores import WINDOW_FRAMES, score_pose_covariance, score_states
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.plugins.evaluation.view_scores import scored_view
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.runs import RunFolder

VIEWS = 20
"""Number of scored views, evenly spread over the believed frames that no map was fitted to."""
READ = ("input", "render")
"""Sections of a run's settings that decide how views are rendered."""
Poses = NDArray[np.float64]


def score(folder: Path, path: str, limit: int) -> dict[str, Any]:
    """Return the figures of a run of a recording with truth. What this code cannot read of another version is None, and
    `unread` says why. Raises SigmaSplatError if there is no path."""
    run, source = RunFolder.open(folder), open_source(path, limit=limit)
    frames, truth = run.read_frames(), source.truth()
    assert truth is not None
    states = score_states(run, frames, truth)
    rows, true_rows = associate(frames.path.timestamps_s, truth.timestamps_s)
    poses = frames.rows[rows], frames.path.T_world_camera[rows], truth.T_world_camera[true_rows]
    figures: dict[str, Any] = {
        "frames": len(frames),
        "ate_m": ate(frames.path, truth).rmse_m if len(rows) > 2 else None,
        "hops_m": motion_error_m(*poses, 1),
        "windows_m": motion_error_m(*poses, WINDOW_FRAMES),
        "silent": states["failures"]["silent"],
        "lost": len(frames) - len(frames.rows),
    }
    unread = []
    try:
        windows = (score_pose_covariance(run, frames, truth) or {}).get("windows")
        figures["windows_k"] = windows and windows["position_k"]
    except (SigmaSplatError, KeyError, ValueError, TypeError) as problem:
        unread.append(f"covariance of poses: {problem}"[:200])
    try:
        figures |= score_views(run, frames, source)
    except (SigmaSplatError, KeyError, ValueError, TypeError) as problem:
        unread.append(f"submaps: {problem}"[:200])
    return figures | {"unread": unread}


def motion_error_m(rows: NDArray[np.intp], T_estimate: Poses, T_true: Poses, frames: int) -> float | None:
    """Return the root mean square of the position error, m, of motions over a number of frames; None without one.

    rows [B]: the numbers of the frames with poses [B, 4, 4], T_world_camera, in ascending order. Frames between two
    others may lack a pose.
    """
    at = {int(row): i for i, row in enumerate(rows)}
    pairs = [(i, at[row + frames]) for row, i in at.items() if row + frames in at]
    if not pairs:
        return None
    first, last = np.array(pairs).T
    moved, truly = (se3.inverse(T[first]) @ T[last] for T in (T_estimate, T_true))
    errors = (se3.inverse(truly) @ moved)[:, :3, 3]
    return float(np.sqrt((errors**2).sum(1).mean()))


def known_settings(values: dict[str, Any]) -> Config:
    """Return the settings for rendering of a config.json of any version: what this code does not know is left out."""
    config = preset(default_preset())
    for name in READ:
        known = {field.name for field in dataclasses.fields(getattr(config, name))}
        changes = {key: value for key, value in values.get(name, {}).items() if key in known}
        config = Config.from_dict({**config.to_dict(), name: {**config.to_dict()[name], **changes}})
    return config


def score_views(run: RunFolder, frames: RunFrames, source: Source) -> dict[str, float | None]:
    """Return mean PSNR and depth L1 of held-out views, each in the submap of its frame, as metrics.json does."""
    config = known_settings(json.loads((run.path / "config.json").read_text(encoding="utf-8")))
    renderer = FieldRenderer(config.render, config.backend)
    T_submap_camera = np.asarray(run.read_checkpoint()[0]["T_submap_camera"], np.float64)
    chosen = evenly_spread([record for record in frames.posed_log() if not record["is_keyframe"]], VIEWS)
    found, readouts = [], frames.readouts(run.facts())
    for submap, records in groupby(sorted(chosen, key=lambda r: r["submap"]), key=lambda r: r["submap"]):
        field = run.submaps.load(submap).field
        for record in records:
            try:
                frame = working_frame(source, config.input, record["index"], readouts)
            except SourceError:
                continue
            rendered = renderer(field, frame.camera, se3.inverse(T_submap_camera[record["row"]]))
            view = scored_view(frame, rendered, "held-out")
            depths = depth_l1(view.rendered_depth_m, view.recorded_depth_m)
            found.append((psnr(view.rendered, view.recorded, view.valid), depths))
    columns = np.array(found, np.float64).reshape(-1, 2).T
    means = [float(known.mean()) if len(known := column[np.isfinite(column)]) else None for column in columns]
    return dict(zip(("psnr_db", "depth_l1_m"), means, strict=True))
