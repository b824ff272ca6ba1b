"""Fuse depth images with known poses by Open3D's VoxelBlockGrid, for mesh_quality.py; needs numpy and open3d only.

usage: python peer_open3d_mesh.py FOLDER VOXEL_M: reads FOLDER/color.npy, depth.npy, poses.npy (camera to world) and
camera.json, writes FOLDER/open3d-VOXEL_M.ply and version.txt.
"""

import json
import sys
from pathlib import Path

import numpy as np
import open3d as o3d

DEVICE = o3d.core.Device("CPU:0")
BLOCK, BLOCKS, DEPTH_MAX_M, TRUNCATION_VOXELS = 16, 40000, 8.0, 8.0
"""Values of default_config.yml of Open3D's reconstruction system, except the largest depth: that of SigmaSplat."""
WEIGHT = 3.0
"""A voxel needs this many observations, as in extract_triangle_mesh by default."""


def main(folder: Path, voxel_m: float) -> None:
    """Fuse the frames of a folder into a mesh and write it there."""
    color, depth, poses = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("color", "depth", "poses"))
    camera = json.loads((folder / "camera.json").read_text())
    K = o3d.core.Tensor([[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]])
    kinds = (o3d.core.float32,) * 3
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), kinds, ((1), (1), (3)), voxel_m, BLOCK, BLOCKS, DEVICE
    )
    for c, d, T_world_camera in zip(color, depth, poses, strict=True):
        if not np.isfinite(T_world_camera).all():
            continue
        seen = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(d), device=DEVICE))
        shown = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(c, np.float32) / np.float32(255.0)))
        T_camera_world = o3d.core.Tensor(np.linalg.inv(T_world_camera))
        blocks = grid.compute_unique_block_coordinates(seen, K, T_camera_world, 1.0, DEPTH_MAX_M, TRUNCATION_VOXELS)
        grid.integrate(blocks, seen, shown, K, K, T_camera_world, 1.0, DEPTH_MAX_M, TRUNCATION_VOXELS)
    mesh = grid.extract_triangle_mesh(WEIGHT).to_legacy()
    o3d.io.write_triangle_mesh(str(folder / f"open3d-{voxel_m:g}.ply"), mesh, write_vertex_normals=False)
    (folder / "version.txt").write_text(f"open3d {o3d.__version__}\n")


if __name__ == "__main__":
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    main(Path(sys.argv[1]), float(sys.argv[2]))
