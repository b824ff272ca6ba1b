"""Run SLAM on a depth camera that OpenCV reads, until Ctrl-C; write its path and map.

python examples/opencv_camera.py [OUT]      OUT a folder (default: camera-out)

For Orbbec cameras: OpenCV reads them without another SDK. For cameras that OpenNI2 reads, replace `CAP_OBSENSOR` by
`CAP_OPENNI2` and `CAP_OPENNI`, and give K yourself. Depth must be registered to colour. Tested with a simulated camera.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from sigmasplat import RealTime, SigmaSplatError, Slam
from sigmasplat.run.session import interrupt_event
from sigmasplat.run_folder.splat_ply import write_field
from sigmasplat.run_folder.trajectory import write_trajectory

FOCAL = [getattr(cv2, f"CAP_PROP_OBSENSOR_INTRINSIC_{name}") for name in ("FX", "FY", "CX", "CY")]


def images(capture: cv2.VideoCapture) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield time in seconds, colour in the order blue, green, red, and depth in whole millimetres."""
    while capture.grab():
        time_s = time.monotonic()
        has_color, bgr = capture.retrieve(None, cv2.CAP_OBSENSOR_BGR_IMAGE)
        has_depth, depth = capture.retrieve(None, cv2.CAP_OBSENSOR_DEPTH_MAP)
        if has_color and has_depth:
            yield time_s, bgr, depth


def main(out: str = "camera-out") -> RealTime:
    """Track images until they end or Ctrl-C is pressed, then write trajectory.txt and map.ply into `out`."""
    capture, slam = cv2.VideoCapture(0, cv2.CAP_OBSENSOR), RealTime(Slam("sigma"))
    K = [capture.get(number) for number in FOCAL]
    slam.on_correction(lambda moved: print(f"{len(moved.frames)} poses moved by up to {moved.moved_m.max():.3f} m"))
    with interrupt_event() as stopped:  # Ctrl-C ends the loop after an image, never in the middle of one
        for time_s, bgr, depth in images(capture):
            try:
                step = slam.track(bgr, depth, K, time_s, depth_scale=1000, color_order="bgr")
            except SigmaSplatError as problem:  # for example a first image without depth
                print(problem)
                continue
            x, y, z = step.T_world_camera[:3, 3]
            std_m = np.nan if step.covariance is None else np.sqrt(step.covariance[:3, :3].trace())
            print(f"{step.index:5d}  {step.state:11s} x={x:+.3f} y={y:+.3f} z={z:+.3f} ± {std_m:.3f} m")
            if stopped.is_set():
                break
    capture.release()
    print("making the final map")
    slam.finish()
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_trajectory(folder / "trajectory.txt", slam.trajectory().at(slam.valid()))
    write_field(folder / "map.ply", slam.field)
    return slam


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except SigmaSplatError as problem:
        sys.exit(str(problem))
