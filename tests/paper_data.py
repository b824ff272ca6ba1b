"""Write walks in the synthetic room, or real frames, in the layouts of Replica, TUM RGB-D, ScanNet and ScanNet++.

Each tree has some scenes of the papers and misses the others.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from layouts import opengl, rows, save, save_text, transforms, tum_line
from paper_settings import InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.outputs.mesh_files import write_mesh
from sigmasplat.plugins.sources import SyntheticRoom, open_source

FRAMES, WIDTH, HEIGHT = 8, 80, 60
TINY = {
    "input.width": "80", "seeding.first_uniform": "1500", "seeding.first_gradient": "300",
    "mapping.first_iterations": "4", "mapping.iterations": "3", "mapping.every": "3", "tracking.iterations": "5",
    "registration.iterations": "2",
    "final.iterations": "4", "submaps.frames": "5", "tracking.alpha_above": "0", "tracking.method": "align",
}  # fmt: skip
"""Settings that make a run of these scenes short, and not fail, for every preset of a paper."""


def tiny_options() -> list[str]:
    return [word for name, value in TINY.items() for word in ("--set", f"{name}={value}")]


Walk = tuple[list[Frame], np.ndarray]
"""Frames, and their true poses T_world_camera [N, 4, 4]."""


def recorded(folder: Path, every: int = 2) -> Walk:
    """Return small images of each n-th frame of a real sequence, and their true poses."""
    source = open_source(folder, InputConfig(stride=every, limit=FRAMES))
    frames, truth = [smaller(source.frame(i)) for i in range(FRAMES)], source.truth()
    found, true = associate(np.array([frame.timestamp_s for frame in frames]), truth.timestamps_s)
    assert found.tolist() == list(range(FRAMES))
    return frames, truth.T_world_camera[true]


def smaller(frame: Frame) -> Frame:
    """Return a frame of WIDTH × HEIGHT pixels: mean colours, and the depth at the centre of each pixel."""
    n = frame.camera.width // WIDTH
    color = frame.color.reshape(HEIGHT, n, WIDTH, n, 3).mean((1, 3))
    depth_m = frame.depth_m[n // 2 :: n, n // 2 :: n]
    return Frame(frame.index, frame.timestamp_s, color, depth_m, frame.camera.resized(WIDTH, HEIGHT))


def seen_surface(walk: Walk) -> Mesh:
    """Return a mesh of the surfaces that the first and the last frame see."""
    vertices, faces, count = [], [], 0
    for n in (0, -1):
        frame, T = walk[0][n], walk[1][n]
        points = (frame.camera.rays() * frame.depth_m[..., None]).reshape(-1, 3)
        corner = np.arange(len(points)).reshape(frame.depth_m.shape)
        a, b, c, d = (corner[y, x].ravel() for y in (np.s_[:-1], np.s_[1:]) for x in (np.s_[:-1], np.s_[1:]))
        depths = frame.depth_m.ravel()[np.stack([a, b, c, d])]
        smooth = (depths.min(0) > 0) & (np.ptp(depths, axis=0) < 0.2)
        faces.append(count + np.concatenate([np.stack(t, 1)[smooth] for t in ((a, c, b), (b, c, d))]))
        vertices.append(points @ T[:3, :3].T + T[:3, 3])
        count += len(points)
    return Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))


def room(seed: int, whole_walk: int = 160) -> Walk:
    """Return frames of a synthetic room, and their true poses: the beginning of a walk of some number of frames."""
    source = SyntheticRoom(frames=whole_walk, width=WIDTH, height=HEIGHT, seed=seed)
    return [source.frame(i) for i in range(FRAMES)], source.truth().T_world_camera[:FRAMES]


def images(frame: Frame, units_per_metre: float) -> tuple[np.ndarray, np.ndarray]:
    color = np.rint(255 * frame.color).astype(np.uint8)
    return color, np.rint(units_per_metre * frame.depth_m).astype(np.uint16)


def write_replica(root: Path, walks: Mapping[str, Walk], surfaces: bool = False) -> Path:
    """Write scenes by name, and the meshes of their true surfaces if asked."""
    for scene, walk in walks.items():
        frames, poses = walk
        for n, frame in enumerate(frames):
            color, depth = images(frame, 6553.5)
            save(root / scene / f"results/frame{n:06d}.jpg", color, quality=95)
            save(root / scene / f"results/depth{n:06d}.png", depth)
        save_text(root / scene / "traj.txt", "".join(" ".join(rows(T).split()) + "\n" for T in poses))
        if surfaces:
            write_mesh(root / f"{scene}_mesh.ply", seen_surface(walk))
    c = frames[0].camera
    camera = {"w": WIDTH, "h": HEIGHT, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 6553.5}
    save_text(root / "cam_params.json", json.dumps({"camera": camera}))
    return root


def write_tum(root: Path, walk: Walk) -> Path:
    folder = root / "rgbd_dataset_freiburg1_desk"
    frames, poses = walk
    lists = {"rgb": "# color images\n", "depth": "# depth maps\n", "groundtruth": "# ground truth trajectory\n"}
    for n, frame in enumerate(frames):
        t = 1305031452.791720 + n / 30
        for kind, pixels in zip(("rgb", "depth"), images(frame, 5000.0), strict=True):
            save(folder / f"{kind}/{t:.6f}.png", pixels)
            lists[kind] += f"{t:.6f} {kind}/{t:.6f}.png\n"
        lists["groundtruth"] += tum_line(f"{t:.4f}", poses[n])
    for name, text in lists.items():
        save_text(folder / f"{name}.txt", text)
    c = frames[0].camera
    fields = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": WIDTH, "height": HEIGHT, "depth_scale": 5000}
    save_text(folder / "calibration.json", json.dumps(fields))  # the images are smaller than those of Freiburg 1
    return root


def write_scannet(root: Path, walk: Walk) -> Path:
    folder = root / "scans" / "scene0000_00"
    frames, poses = walk
    for n, frame in enumerate(frames):
        color, depth = images(frame, 1000.0)
        save(folder / f"color/{n}.jpg", color, quality=95)
        save(folder / f"depth/{n}.png", depth)
        save_text(folder / f"pose/{n}.txt", rows(poses[n]))
    c = frames[0].camera
    K = np.array([[c.fx, 0, c.cx, 0], [0, c.fy, c.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for kind in ("color", "depth"):
        save_text(folder / f"intrinsic/intrinsic_{kind}.txt", rows(K))
        save_text(folder / f"intrinsic/extrinsic_{kind}.txt", rows(np.eye(4)))
    return root


def write_scannetpp(root: Path, walk: Walk) -> Path:
    """The last two frames are test views."""
    dslr = root / "data" / "b20a261fdf" / "dslr"
    frames, poses = walk
    listed = []
    for n, frame in enumerate(frames):
        color, depth = images(frame, 1000.0)
        save(dslr / f"undistorted_images/DSC{n:05d}.JPG", color, quality=95)
        save(dslr / f"undistorted_depths/DSC{n:05d}.png", depth)
        listed.append({"file_path": f"DSC{n:05d}.JPG", "transform_matrix": opengl(poses[n]), "is_bad": False})
    text = transforms(frames[0].camera, listed[:-2], test_frames=listed[-2:], camera_model="PINHOLE")
    save_text(dslr / "nerfstudio/transforms_undistorted.json", text)
    names = [entry["file_path"] for entry in listed]
    save_text(dslr / "train_test_lists.json", json.dumps({"train": names[:-2], "test": names[-2:]}))
    return root
