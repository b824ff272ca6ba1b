"""What a run keeps in its checkpoint."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.graph.path_covariance import recorded


def checkpoint_of(
    active: GaussianField, path: Trajectory, atlas: Atlas, keyframes: Sequence[int], edges: Sequence[RelativePose]
) -> dict[str, Tensor]:
    """Return the active submap's field with its attributes and its optimiser state, poses, times, keyframes, anchors,
    the submap of each frame, the exposures of frames if they are known, and the errors of the path, in host
    memory."""
    return {
        **_rows_of(active, ""),
        **{key: part for name, rows in active.attributes.items() for key, part in _rows_of(rows, f"{name}_").items()},
        "timestamps_s": torch.from_numpy(path.timestamps_s),
        "T_world_camera": torch.from_numpy(path.T_world_camera),
        "T_world_camera_odometry": torch.from_numpy(atlas.T_world_camera(loops=False)),
        "T_world_keyframe": torch.from_numpy(atlas.T_world_keyframes),
        "T_submap_camera": torch.from_numpy(atlas.T_submap_camera),
        **path_errors(atlas, keyframes, edges),
    }


def path_errors(atlas: Atlas, keyframes: Sequence[int], edges: Sequence[RelativePose]) -> dict[str, Tensor]:
    """Return the part of a checkpoint that `PathCovariance.of` reads; arguments as for `checkpoint_of`."""
    return {
        "keyframes": torch.tensor(keyframes, dtype=torch.int64),
        "T_world_submap": torch.from_numpy(np.array(atlas.anchors)),
        "submap_component": torch.tensor(atlas.components, dtype=torch.int64),
        "frame_submap": torch.tensor(atlas.places.submap),
        **({"exposure": torch.from_numpy(atlas.frame_exposures())} if atlas.exposures else {}),
        **recorded(atlas, edges),
    }


def _rows_of(rows: Rows, prefix: str) -> dict[str, Tensor]:
    """Return the parameters and the optimiser state of rows, in host memory, with a prefix to each name."""
    parts = {f"{prefix}{name}": getattr(rows, name).cpu() for name in ("params", "moment1", "moment2", "last_step")}
    return parts | {f"{prefix}adam_steps": torch.tensor(rows.steps)}
