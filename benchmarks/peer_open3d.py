"""Run one of Open3D's RGB-D methods on prepared frames, for peers.py; needs numpy and open3d only, not sigmasplat.

usage: python peer_open3d.py FOLDER METHOD: reads FOLDER/color.npy, depth.npy and camera.json, writes FOLDER/poses.npy
(float64 [N, 4, 4], camera to world, metres; NaN for a frame without a pose), version.txt, and the times of
peer_clock.py. A call begins with decoded images in memory and ends with the pose.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from peer_clock import Clock

DEVICE = o3d.core.Device("CPU:0")
DEPTH_MIN_M, VOXEL_SIZE_M, BLOCKS, DISTANCE_M, TRUNCATION_VOXELS = 0.1, 0.0058, 40000, 0.07, 8.0
"""Values of default_config.yml of Open3D's reconstruction system."""
MODEL_DEPTH_MAX_M, ODOMETRY_DEPTH_MAX_M = 3.0, 8.0
"""The first value is Open3D's default. Odometry is better with the range that SigmaSplat uses."""
ITERATIONS = {"PointToPlane": (10, 5, 3), "Hybrid": (60, 30, 15, 5)}
"""Iterations per level, coarse to fine. The first are Open3D's default, with which hybrid does not converge at full
size."""
Frames = tuple[Any, Any, Any]


def image(pixels: Any) -> Any:
    """Return an array of pixels as an image of Open3D."""
    return o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(pixels), device=DEVICE))


def odometry(name: str) -> Callable[[Frames, Clock], Any]:
    """Return a function that chains the motions from each frame to the next, each from the identity."""
    criteria = [o3d.t.pipelines.odometry.OdometryConvergenceCriteria(n) for n in ITERATIONS[name]]
    method = getattr(o3d.t.pipelines.odometry.Method, name)
    settings = {"depth_scale": 1.0, "depth_max": ODOMETRY_DEPTH_MAX_M, "criteria_list": criteria, "method": method}

    def track(frames: Frames, clock: Clock) -> Any:
        color, depth, K = frames
        poses, T_world_last, last = [], np.eye(4), None
        for c, d in zip(color, depth, strict=True):
            seen = np.array(c), np.array(d)  # read from the files before the call
            known = True
            with clock.call():
                live = o3d.t.geometry.RGBDImage(*map(image, seen))
                if last is not None:
                    try:
                        found = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(live, last, K, **settings)
                        T_world_last = T_world_last @ found.transformation.numpy()
                    except RuntimeError:  # too few correspondences: the chain continues with the last pose
                        known = False
            poses.append(T_world_last if known else np.full((4, 4), np.nan))
            last = live
        return np.array(poses)

    return track


def dense_slam(frames: Frames, clock: Clock) -> Any:
    """Track each frame against the surface fused so far, as Open3D's example dense_slam.py does."""
    color, depth, K = frames
    rows, columns = depth.shape[1:]
    slam = o3d.t.pipelines.slam
    T_world_camera = o3d.core.Tensor(np.eye(4))
    model = slam.Model(VOXEL_SIZE_M, 16, BLOCKS, T_world_camera, DEVICE)
    live, rendered = (slam.Frame(rows, columns, K, DEVICE) for _ in range(2))
    poses = []
    for i in range(len(color)):
        c, d = np.array(color[i]), np.array(depth[i])  # read from the files before the call
        found = True
        with clock.call():
            live.set_data_from_image("depth", image(d))
            live.set_data_from_image("color", image(c.astype(np.float32) / 255.0))
            if i:
                try:
                    result = model.track_frame_to_model(live, rendered, 1.0, MODEL_DEPTH_MAX_M, DISTANCE_M)
                    T_world_camera = T_world_camera @ result.transformation
                except RuntimeError:
                    found = False
        poses.append(T_world_camera.numpy().copy() if found else np.full((4, 4), np.nan))
        model.update_frame_pose(i, T_world_camera)
        if found:
            model.integrate(live, 1.0, MODEL_DEPTH_MAX_M, TRUNCATION_VOXELS)
        model.synthesize_model_frame(rendered, 1.0, DEPTH_MIN_M, MODEL_DEPTH_MAX_M, TRUNCATION_VOXELS, False)
    return np.array(poses)


METHODS = {
    "point-to-plane": odometry("PointToPlane"),
    "hybrid": odometry("Hybrid"),
    "dense-slam": dense_slam,
}


def main(folder: Path, method: str) -> None:
    """Run a method on the frames of a folder and write its poses there."""
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    color, depth = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("color", "depth"))
    camera = json.loads((folder / "camera.json").read_text())
    K = [[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]]
    clock = Clock()
    poses = METHODS[method]((color, depth, o3d.core.Tensor(np.array(K))), clock)
    clock.write(folder)
    np.save(folder / "poses.npy", poses)
    (folder / "version.txt").write_text(f"open3d {o3d.__version__}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
