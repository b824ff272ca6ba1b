"""A run made by hand in the room of `box_room`: six frames, the fourth lost, keyframes 0, 2, 4."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from box_room import CAMERA, splats, walk
from sigmasplat.data import se3
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder

FRAMES, LOST = 6, 3
T_ROOM = walk(np.eye(4), FRAMES).T_world_camera[0]
WORLD = se3.inverse(T_ROOM)
"""T_world_room: the world is the first camera."""
PATH = walk(WORLD, FRAMES)
SMALL = CAMERA.resized(40, 30)


def picture(i: int) -> Picture:
    depth = np.full((30, 40), 1.5 + 0.001 * i, np.float32)
    depth[0, 0] = 0.0
    return Picture(np.full((30, 40, 3), 10 * i, np.uint8), depth)


def made_run(folder: Path, submaps: bool) -> RunFolder:
    """Write the run, in two submaps that share frame 2, or in one piece."""
    run = RunFolder.create(folder, BASE, "walls")
    run.note(camera=asdict(SMALL))
    for i in range(FRAMES):
        run.log({"index": i, "timestamp_s": i / 10, "is_keyframe": i in (0, 2, 4), "lost": i == LOST, "seconds": {}})
    run.write_trajectory(PATH.at(np.arange(FRAMES) != LOST))
    run.write_map(splats(WORLD))
    tensors = {
        "timestamps_s": torch.from_numpy(PATH.timestamps_s),
        "T_world_camera": torch.from_numpy(PATH.T_world_camera),
        "keyframes": torch.tensor([0, 2, 4]),
    }
    if submaps:
        anchors = PATH.T_world_camera[[0, 2]]
        for index, frames in enumerate(((0, 2), (2, 4))):
            poses = np.stack([se3.inverse(anchors[index]) @ PATH.T_world_camera[i] for i in frames])
            submap = Submap(index, splats(se3.inverse(anchors[index]) @ WORLD), frames, poses, SMALL)
            run.submaps.save(submap, [picture(i) for i in frames])
        tensors["T_world_submap"] = torch.from_numpy(anchors)
    run.write_checkpoint(tensors, {})
    return run
