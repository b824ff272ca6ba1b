"""Write walks in the synthetic room in the layouts of Replica, TUM RGB-D, ScanNet and ScanNet++.

Each tree has some scenes of the papers and misses the others.
"""

import json
from pathlib import Path

import numpy as np

from layouts import opengl, rows, save, save_text, transforms, tum_line
from sigmasplat.model.frame import Frame
from sigmasplat.sources import SyntheticRoom

FRAMES, WIDTH, HEIGHT = 8, 80, 60
TINY = {
    "input.width": "80", "seeding.first_uniform": "1500", "seeding.first_gradient": "300",
    "mapping.first_iterations": "4", "mapping.iterations": "3", "mapping.every": "3", "tracking.iterations": "5",
    "registration.iterations": "2",
    "final.iterations": "4", "submaps.frames": "5", "tracking.alpha_above": "0",
}  # fmt: skip
"""Settings that make a run of these scenes short, for every preset of a paper."""


def tiny_options() -> list[str]:
    return [word for name, value in TINY.items() for word in ("--set", f"{name}={value}")]


def room(seed: int) -> tuple[list[Frame], np.ndarray]:
    """Return frames of a room, and their true poses."""
    source = SyntheticRoom(frames=160, width=WIDTH, height=HEIGHT, seed=seed)
    return [source.frame(i) for i in range(FRAMES)], source.truth().T_world_camera[:FRAMES]


def images(frame: Frame, units_per_metre: float) -> tuple[np.ndarray, np.ndarray]:
    color = np.rint(255 * frame.color).astype(np.uint8)
    return color, np.rint(units_per_metre * frame.depth_m).astype(np.uint16)


def write_replica(root: Path, scenes: tuple[str, ...] = ("room0", "office0")) -> Path:
    for seed, scene in enumerate(scenes):
        frames, poses = room(seed)
        for n, frame in enumerate(frames):
            color, depth = images(frame, 6553.5)
            save(root / scene / f"results/frame{n:06d}.jpg", color, quality=95)
            save(root / scene / f"results/depth{n:06d}.png", depth)
        save_text(root / scene / "traj.txt", "".join(" ".join(rows(T).split()) + "\n" for T in poses))
    c = frames[0].camera
    camera = {"w": WIDTH, "h": HEIGHT, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 6553.5}
    save_text(root / "cam_params.json", json.dumps({"camera": camera}))
    return root


def write_tum(root: Path) -> Path:
    folder = root / "rgbd_dataset_freiburg1_desk"
    frames, poses = room(2)
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


def write_scannet(root: Path) -> Path:
    folder = root / "scans" / "scene0000_00"
    frames, poses = room(3)
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


def write_scannetpp(root: Path) -> Path:
    """The last two frames are test views."""
    dslr = root / "data" / "b20a261fdf" / "dslr"
    frames, poses = room(4)
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
