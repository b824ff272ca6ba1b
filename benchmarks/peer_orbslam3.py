"""Run ORB-SLAM3 (RGB-D) on prepared frames, for peers.py; needs numpy, opencv and pyorbslam3 only, not sigmasplat.

usage: python peer_orbslam3.py FOLDER VOCABULARY [camera]: reads FOLDER/color.npy, depth.npy, times.npy and camera.json,
writes FOLDER/poses.npy (float64 [N, 4, 4], camera to world, metres; NaN for a frame without a pose), version.txt, and
the times of peer_clock.py. Frames come half a second apart; with `camera`, at their own times, and none is dropped.
If tracking is lost, ORB-SLAM3 starts a new map with a new origin: only the map of most frames is kept.
VOCABULARY is ORB-SLAM3's ORBvoc.txt. If the file does not exist, it is made from the frames of the folder.
"""

import json
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyorbslam3
from peer_clock import Clock

BRANCHES, LEVELS, ROUNDS = 10, 6, 8
"""Numbers of branches and levels, as in the published vocabulary, and rounds of k-majority clustering."""
SECONDS_PER_FRAME = 0.5
"""Delay between frames. ORB-SLAM3 maps in its own threads, which cannot keep up if frames come too fast."""
SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {fx}
Camera1.fy: {fy}
Camera1.cx: {cx}
Camera1.cy: {cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""
"""ORB-SLAM3's settings for TUM RGB-D, with the camera of the frames."""


def descriptors_of(color: Any, every: int = 3) -> Any:
    """Return the ORB descriptors of every third frame, bits as float32 [M, 256]."""
    orb = cv2.ORB_create(1000)
    found = [orb.detectAndCompute(np.ascontiguousarray(image), None)[1] for image in color[::every]]
    return np.unpackbits(np.concatenate([d for d in found if d is not None]), axis=1).astype(np.float32)


def clusters(bits: Any, random: np.random.Generator) -> tuple[Any, Any]:
    """Cluster binary descriptors [M, 256] by k-majority; return centres [≤ 10, 256] and the cluster of each [M]."""
    centres = np.unique(bits[random.permutation(len(bits))[:BRANCHES]], axis=0)
    for _ in range(ROUNDS):
        nearest = (bits @ (1 - 2 * centres.T) + centres.sum(1)).argmin(1)  # Hamming distance minus a constant
        kept = np.unique(nearest)
        centres = np.array([bits[nearest == k].mean(0) >= 0.5 for k in kept], np.float32)
    return centres, (bits @ (1 - 2 * centres.T) + centres.sum(1)).argmin(1)


def write_vocabulary(path: Path, color: Any) -> None:
    """Write a tree of visual words, trained on images, in the text format of DBoW2 (TF-IDF weights, L1 score)."""
    random, lines, images = np.random.default_rng(0), [], len(color[::3])

    def grow(bits: Any, parent: int, level: int) -> None:
        if len(np.unique(bits, axis=0)) <= BRANCHES:
            centres, nearest = np.unique(bits, axis=0, return_inverse=True)
        else:
            centres, nearest = clusters(bits, random)
        for k, centre in enumerate(centres):
            members = bits[np.ravel(nearest) == k]
            leaf = level == LEVELS or (level > 2 and len(members) <= 1) or not len(members)
            weight = max(np.log(images / max(min(len(members), images - 1), 1)), 1e-3) if leaf else 0.0
            packed = " ".join(map(str, np.packbits(centre.astype(bool))))
            lines.append(f"{parent} {int(leaf)} {packed} {weight:.6f}")
            if not leaf:
                grow(members, len(lines), level + 1)

    grow(descriptors_of(color), 0, 1)
    path.write_text(f"{BRANCHES} {LEVELS} 0 0\n" + "\n".join(lines) + "\n")


def read_poses(path: Path, times: Any) -> Any:
    """Read TUM text into poses [N, 4, 4] at the given times; NaN where the file has none."""
    poses = np.full((len(times), 4, 4), np.nan)
    for line in path.read_text().splitlines():
        t, *position, x, y, z, w = map(float, line.split())
        row = int(np.abs(times - t).argmin())
        R = np.eye(3) + 2 * np.array(
            [
                [-(y * y + z * z), x * y - z * w, x * z + y * w],
                [x * y + z * w, -(x * x + z * z), y * z - x * w],
                [x * z - y * w, y * z + x * w, -(x * x + y * y)],
            ]
        ) / (x * x + y * y + z * z + w * w)
        poses[row] = np.eye(4)
        poses[row, :3, :3], poses[row, :3, 3] = R, position
    return poses


def main(folder: Path, vocabulary: Path, at_camera_times: bool) -> None:
    """Run ORB-SLAM3 on the frames of a folder and write its poses there."""
    color, depth = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("color", "depth"))
    times, camera = np.load(folder / "times.npy"), json.loads((folder / "camera.json").read_text())
    if not vocabulary.exists():
        write_vocabulary(vocabulary, color)
    settings, path = folder / "orbslam3.yaml", folder / "orbslam3.txt"
    settings.write_text(SETTINGS.format(**camera))
    slam = pyorbslam3.Slam(vocabulary, settings, pyorbslam3.Sensor.RGBD)
    maps, newest, arrivals_s = [], -1, np.append(times[1:], times[-1]) - times[0]
    clock, first = Clock(), time.monotonic()
    for i, t in enumerate(times):
        start = time.monotonic()
        seen = np.array(color[i]), np.array(depth[i])  # read from the files before the call
        with clock.call():
            found = slam.track_rgbd(*seen, float(t))
        if found.pose_valid and np.array_equal(found.pose_wc, np.eye(4)):
            newest += 1  # every map starts at the identity
        maps.append(newest if found.pose_valid else -1)
        next_frame = first + arrivals_s[i] if at_camera_times else start + SECONDS_PER_FRAME
        clock.wait(next_frame - time.monotonic())
    clock.write(folder)
    slam.shutdown()
    slam.save_trajectory_tum(str(path))
    poses = read_poses(path, times)
    largest = max(set(maps), key=lambda k: (k >= 0, maps.count(k)))
    poses[np.array(maps) != largest] = np.nan
    np.save(folder / "poses.npy", poses)
    (folder / "version.txt").write_text(f"pyorbslam3 {metadata.version('pyorbslam3')}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), "camera" in sys.argv[3:])
