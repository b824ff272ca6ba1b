"""Write a few frames in the layout of each data set, independent of the code under test."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sigmasplat.data.camera import Camera

FRAMES = 4
VGA, SMALL = (640, 480), (32, 24)
SMALL_CAMERA = Camera(32, 24, 30.0, 31.0, 15.25, 11.75)


@dataclass(frozen=True)
class Sample:
    """The content to write: color uint8 [N, H, W, 3], depth in mm uint16 [N, H, W], T_world_camera [N, 4, 4]."""

    color: np.ndarray
    depth_mm: np.ndarray
    T_world_camera: np.ndarray


def sample(size: tuple[int, int] = SMALL) -> Sample:
    """Make smooth colours, depths from 0 (no reading) to 5 m, and poses that rotate about all axes."""
    width, height = size
    u, v = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    i = np.arange(FRAMES)[:, None, None]
    color = np.stack([u + 0 * i, v + 0 * i, (u + v) / 2 * (i + 1) / FRAMES], -1) * 255
    depth = 1000 + 100 * i + np.rint(3900 * u * v).astype(int)
    depth[:, : height // 8, : width // 8] = 0
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for n in range(FRAMES):
        for axes, angle in (((0, 1), 0.3 * n + 0.1), ((0, 2), -0.2 * n), ((1, 2), 0.5 + 0.1 * n)):
            turn = np.eye(4)
            turn[np.ix_(axes, axes)] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            poses[n] = poses[n] @ turn
        poses[n, :3, 3] = [0.1 * n, -0.2 * n, 0.3 + 0.05 * n]
    return Sample(color.astype(np.uint8), depth.astype(np.uint16), poses)


def save(path: Path, pixels: np.ndarray, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


def save_pairs(folder: Path, s: Sample, names: Iterable[str]) -> None:
    """Write color/NAME.png and depth/NAME.png of every frame."""
    for name, color, depth_mm in zip(names, s.color, s.depth_mm, strict=True):
        save(folder / f"color/{name}.png", color)
        save(folder / f"depth/{name}.png", depth_mm)


def save_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def rows(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.17g}" for value in row) for row in T) + "\n"


def quaternion_xyzw(R: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat().tolist()


def tum_line(t: float | int, T: np.ndarray) -> str:
    return " ".join(str(value) for value in (t, *T[:3, 3], *quaternion_xyzw(T[:3, :3]))) + "\n"


def write_tum(folder: Path, s: Sample, units: int = 5) -> Path:
    """Write lists with realistic times, depth 4 ms late; depth has the unit 1/(1000 · units) m."""
    times = [1305031102.175304 + 0.033 * n for n in range(FRAMES)]
    for n, t in enumerate(times):
        save(folder / f"rgb/{t:.6f}.png", s.color[n])
        save(folder / f"depth/{t + 0.004:.6f}.png", s.depth_mm[n] * units)
    heading = "# color images\n# file: 'x.bag'\n# timestamp filename\n"
    save_text(folder / "rgb.txt", heading + "".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in times))
    save_text(folder / "depth.txt", heading + "".join(f"{t + 0.004:.6f} depth/{t + 0.004:.6f}.png\n" for t in times))
    truth = zip(times, s.T_world_camera, strict=True)
    save_text(folder / "groundtruth.txt", "".join(tum_line(round(t, 6), T) for t, T in truth))
    return folder


def tum(place: Path, s: Sample) -> Path:
    return write_tum(place / "rgbd_dataset_freiburg3_sample", s)


T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
T_M = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])


def bonn(place: Path, s: Sample) -> Path:
    """Write marker poses: T_camera = T_ROS T_markers T_ROS T_m, with the rotation of T_m without its scale."""
    u, _, vt = np.linalg.svd(T_M)
    T_m = np.eye(4)
    T_m[:3, :3], T_m[:3, 3] = u @ vt, [0.0113, -0.0098, 0.0111]
    markers = np.linalg.inv(T_ROS) @ s.T_world_camera @ np.linalg.inv(T_ROS @ T_m)
    return write_tum(place / "rgbd_bonn_sample", Sample(s.color, s.depth_mm, markers))


def replica(place: Path, s: Sample) -> Path:
    folder = place / "room0"
    for n in range(FRAMES):
        save(folder / f"results/frame{n:06d}.jpg", s.color[n], quality=100, subsampling=0)
        save(folder / f"results/depth{n:06d}.png", s.depth_mm[n])
    save_text(folder / "traj.txt", "".join(rows(T).replace("\n", " ").strip() + "\n" for T in s.T_world_camera))
    c = SMALL_CAMERA
    camera = {"w": 32, "h": 24, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 1000.0}
    save_text(place / "cam_params.json", json.dumps({"camera": camera}))
    return folder


LARGE = SMALL_CAMERA.resized(64, 48)


def intrinsic(c: Camera) -> np.ndarray:
    return np.array([[c.fx, 0, c.cx, 0], [0, c.fy, c.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def scannet(place: Path, s: Sample) -> Path:
    """Colour has twice the width of depth and the same camera; frame 2 has no pose."""
    folder = place / "scene0000_00"
    for n in range(FRAMES):
        name = str(n * 7)  # not padded: 7 comes before 14
        save(folder / f"color/{name}.jpg", s.color[n].repeat(2, 0).repeat(2, 1), quality=100, subsampling=0)
        save(folder / f"depth/{name}.png", s.depth_mm[n])
        T = np.full((4, 4), -np.inf) if n == 2 else s.T_world_camera[n]
        save_text(folder / f"pose/{name}.txt", rows(T))
    save_text(folder / "intrinsic/intrinsic_color.txt", rows(intrinsic(LARGE)))
    save_text(folder / "intrinsic/intrinsic_depth.txt", rows(intrinsic(SMALL_CAMERA)))
    for kind in ("color", "depth"):
        save_text(folder / f"intrinsic/extrinsic_{kind}.txt", rows(np.eye(4)))
    return folder


def transforms(c: Camera, frames: list[dict[str, Any]], **more: Any) -> str:
    fields = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx + 0.5, "cy": c.cy + 0.5, "w": c.width, "h": c.height}
    return json.dumps({**fields, **more, "frames": frames})


def opengl(T: np.ndarray) -> list[list[float]]:
    return (T @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def scannet_preprocessed(place: Path, s: Sample) -> Path:
    """As LoopSplat's script writes it: floats in metres, a pose per frame, times of the day when it ran."""
    folder = place / "scene0000_00"
    text = "# timestamp tx ty tz qx qy qz qw\n"
    for n, (color, depth_mm, T) in enumerate(zip(s.color, s.depth_mm, s.T_world_camera, strict=True)):
        save(folder / f"rgb/frame_{n:05d}.png", color)
        save(folder / f"depth/frame_{n:05d}.TIFF", depth_mm.astype(np.float32) / 1000)
        text += tum_line(f"{1700000000 + n / 20:.4f}", T)
    save_text(folder / "gt_pose.txt", text)
    save_text(folder / "intrinsic.txt", rows(intrinsic(SMALL_CAMERA)))
    return folder


def scannetpp(place: Path, s: Sample) -> Path:
    """Frame 3 is a test view; the training photographs are not listed in order."""
    dslr = place / "0a5c013435" / "dslr"
    for n in range(FRAMES):
        save(dslr / f"undistorted_images/DSC{n:05d}.JPG", s.color[n], quality=100, subsampling=0)
        save(dslr / f"undistorted_depths/DSC{n:05d}.png", s.depth_mm[n])
    frames = [
        {"file_path": f"DSC{n:05d}.JPG", "transform_matrix": opengl(s.T_world_camera[n]), "is_bad": False}
        for n in range(FRAMES)
    ]
    text = transforms(SMALL_CAMERA, frames[2::-1], test_frames=frames[3:], camera_model="PINHOLE")
    save_text(dslr / "nerfstudio/transforms_undistorted.json", text)
    lists = {"train": [f["file_path"] for f in frames[:3]], "test": [frames[3]["file_path"]]}
    save_text(dslr / "train_test_lists.json", json.dumps(lists))
    return dslr.parent


def seven_scenes(place: Path, s: Sample) -> Path:
    folder = place / "chess" / "seq-01"
    for n in range(FRAMES):
        stem = folder / f"frame-{n:06d}"
        save(stem.with_suffix(".color.png"), s.color[n])
        save(stem.with_suffix(".depth.png"), np.where(s.depth_mm[n] == 0, 65535, s.depth_mm[n]).astype(np.uint16))
        text = "\n".join("\t ".join(f" {v:.16e}" for v in row) + "\t" for row in s.T_world_camera[n])
        save_text(stem.with_suffix(".pose.txt"), text + "\n")
    return folder


def icl_nuim(place: Path, s: Sample) -> Path:
    """The ground truth is in the mirrored world: y of camera and world points up."""
    folder = place / "living_room_traj2_frei_png"
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    for n in range(FRAMES):
        save(folder / f"rgb/{n + 1}.png", s.color[n])
        save(folder / f"depth/{n + 1}.png", s.depth_mm[n] * 5)
    numbers = range(1, FRAMES + 1)
    save_text(folder / "associations.txt", "".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in numbers))
    poses = zip(numbers, mirror @ s.T_world_camera @ mirror, strict=True)
    save_text(folder / "livingRoom2.gt.freiburg", "".join(tum_line(n, T) for n, T in poses))
    return folder


def open3d(place: Path, s: Sample) -> Path:
    folder = place / "lounge"
    save_pairs(folder, s, (f"{n + 1:06d}" for n in range(FRAMES)))
    K = intrinsic(SMALL_CAMERA)[:3, :3]
    fields = {"width": 32, "height": 24, "intrinsic_matrix": K.T.ravel().tolist(), "depth_scale": 1000.0, "fps": 15.0}
    save_text(folder / "camera_intrinsic.json", json.dumps(fields))
    log = "".join(f"{n} {n} {n + 1}\n" + rows(T) for n, T in enumerate(s.T_world_camera))
    save_text(folder / "trajectory.log", log)
    return folder


def redwood(place: Path, s: Sample) -> Path:
    """Names contain number and microseconds; colour starts one frame earlier, without depth."""
    folder = place / "00021"
    for n in range(-1, FRAMES):
        save(folder / f"rgb/{n + 2:07d}-{33333 * (n + 1):012d}.jpg", s.color[max(n, 0)], quality=100, subsampling=0)
        if n >= 0:
            save(folder / f"depth/{n + 1:07d}-{33333 * (n + 1) + 5000:012d}.png", s.depth_mm[n])
    save_text(folder / "00021.log", "".join(f"{n} {n} {n + 1}\n" + rows(T) for n, T in enumerate(s.T_world_camera)))
    return folder


def nerfstudio(place: Path, s: Sample) -> Path:
    """Frames 0 … 3 are named 8, 9, 10, 11, and are listed in alphabetical order."""
    folder = place / "capture"
    frames = []
    for n in range(FRAMES):
        save(folder / f"images/frame_{n + 8}.png", s.color[n])
        save(folder / f"depths/frame_{n + 8}.png", s.depth_mm[n])
        names = {"file_path": f"images/frame_{n + 8}.png", "depth_file_path": f"depths/frame_{n + 8}.png"}
        frames.append(names | {"transform_matrix": opengl(s.T_world_camera[n])})
    frames.sort(key=lambda frame: frame["file_path"])
    save_text(folder / "transforms.json", transforms(SMALL_CAMERA, frames, camera_model="OPENCV", k1=0.0, k2=0.0))
    return folder


def plain(place: Path, s: Sample) -> Path:
    folder = place / "my_kitchen"
    save_pairs(folder, s, (f"{n + 8}" for n in range(FRAMES)))
    c = SMALL_CAMERA
    fields = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": 32, "height": 24, "depth_scale": 1000}
    save_text(folder / "calibration.json", json.dumps(fields))
    truth = enumerate(s.T_world_camera)
    save_text(folder / "groundtruth.txt", "".join(tum_line(n / 30, T) for n, T in truth))
    return folder


@dataclass(frozen=True)
class Layout:
    """The layout of a data set, and the expected result of reading it.

    exact: whether colour is stored without loss; train: the frames that make the sequence; posed: those with truth.
    """

    format: str
    write: Callable[[Path, Sample], Path]
    camera: Camera
    size: tuple[int, int] = SMALL
    times_s: Sequence[float] = tuple(n / 30 for n in range(FRAMES))
    exact: bool = True
    train: Sequence[int] = tuple(range(FRAMES))
    posed: Sequence[int] = tuple(range(FRAMES))
    options: dict[str, Any] = field(default_factory=dict)


TUM_TIMES = tuple(1305031102.175304 + 0.033 * n for n in range(FRAMES))
LAYOUTS = {
    "tum": Layout("TUM", tum, Camera(640, 480, 535.4, 539.2, 320.1, 247.6), VGA, TUM_TIMES),
    "bonn": Layout(
        "Bonn dynamic", bonn, Camera(640, 480, 542.822841, 542.57687, 315.59352, 237.756098), VGA, TUM_TIMES,
        options={"undistort": False},
    ),
    "replica": Layout("Replica", replica, SMALL_CAMERA, exact=False),
    "scannet": Layout(
        "ScanNet", scannet, SMALL_CAMERA, times_s=[n * 7 / 30 for n in range(FRAMES)], exact=False, posed=[0, 1, 3]
    ),
    "scannet_preprocessed": Layout("preprocessed ScanNet", scannet_preprocessed, SMALL_CAMERA),
    "scannetpp": Layout("ScanNet++", scannetpp, SMALL_CAMERA, exact=False, train=[0, 1, 2], posed=[0, 1, 2]),
    "seven_scenes": Layout("7-Scenes", seven_scenes, Camera(640, 480, 585.0, 585.0, 320.0, 240.0), VGA),
    "icl_nuim": Layout(
        "ICL-NUIM", icl_nuim, Camera(640, 480, 481.2, 480.0, 319.5, 239.5), VGA, [n / 30 for n in range(1, FRAMES + 1)]
    ),
    "open3d": Layout("Redwood / Open3D", open3d, SMALL_CAMERA, times_s=[n / 15 for n in range(1, FRAMES + 1)]),
    "redwood": Layout(
        "Redwood / Open3D", redwood, Camera(640, 480, 525.0, 525.0, 319.5, 239.5), VGA,
        [0.033333 * (n + 1) + 0.005 for n in range(FRAMES)], exact=False,
    ),
    "nerfstudio": Layout("nerfstudio", nerfstudio, SMALL_CAMERA),
    "plain": Layout("plain folder", plain, SMALL_CAMERA),
}  # fmt: skip
