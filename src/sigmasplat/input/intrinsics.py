"""Read the intrinsics that other programs leave beside the images, as text, YAML or JSON, under their usual names."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.files.reading import exists, read_text
from sigmasplat.input.calibration import Calibration, Origin, build_camera

NAMES = re.compile(
    r"(cam(era)?|colou?r|rgb|calib\w*|sensors|ost|k|tum\d|focal"
    r"|(\w*[-_])?(intrinsics?|camera_info|cam(era)?_k)(_\w+)?)"
)
"""Names of files, without their ending: of ROS, kalibr, ORB-SLAM, BOP, 3DMatch, SUN3D, OpenLORIS and others."""
OPENLORIS = r"(?ms)^d400_color_optical_frame:(.*?)(?=^\S|\Z)"
"""The colour camera of OpenLORIS among its sensors; the order of its intrinsics is fx, cx, fy, cy."""
ENDINGS = (".txt", ".yaml", ".yml", ".json", ".csv", ".cfg")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MATRICES = r"(?:camera_matrix|cam_k|intrinsic_matrix|intrinsics?|k)"
LENSES = r"(?:distortion_coefficients|distortion_coeffs|distortion|dist_coeffs|d)"
UNITS = r"(?:\w*\.)?(?:depthmapfactor|png_depth_scale|depth_map_factor)"
SIZED = r"[\"']?(?:rows|cols|dt)[\"']?\s*:\s*\w+[,\s]*"
OPENED = rf"[\"']?\s*[:=]\s*(?:!!opencv-matrix\s*)?\{{?\s*(?:{SIZED})*(?:[\"']?data[\"']?\s*:\s*)?"
"""What is between a key and its numbers in YAML and JSON: nothing more than a colon, or the head of a matrix."""
MOST_BYTES = 1 << 16
Size = tuple[int, int]


def intrinsics_beside(folder: Path, settings: InputConfig, size: Size, units: float) -> Calibration | None:
    """Return the calibration in the first such file of a folder that holds a camera for images of (width, height);
    None without one, and if there is a calibration.json: the lens of one file must not join the camera of another.
    units: of depth, if the file has none."""
    stated = settings.calibration or exists(folder / "calibration.json")
    files = sorted(folder.iterdir()) if folder.is_dir() and not stated else []
    for path in files:
        if path.suffix.lower() in ENDINGS and NAMES.fullmatch(path.stem.lower()) and path.is_file():
            text = re.sub(r"(?m)#.*$", "", read_text(path, most=MOST_BYTES)).lower()
            if found := _calibration(path, text, size, units):
                return found
    return None


def _calibration(path: Path, text: str, size: Size, units: float) -> Calibration | None:
    loris = re.search(OPENLORIS, text)
    text = loris[1] if loris else text
    named = [_numbers(text, rf"(?:\w*[._])?{key}")[:1] for key in ("fx", "fy", "cx", "cy")]
    focal, lens = [number for found in named for number in found], _numbers(text, LENSES)[:5]
    lens = lens or [n for key in ("k1", "k2", "p1", "p2", "k3") for n in _numbers(text, rf"(?:\w*[._])?{key}")[:1]]
    if len(focal) != 4:
        plain = [float(word) for word in re.findall(NUMBER, text)] if not re.search(r"[a-df-z]", text) else []
        if path.stem.lower() == "focal" and len(plain) == 1:
            plain = [*plain, *plain, (size[0] - 1) / 2, (size[1] - 1) / 2]
        listed = _numbers(text, MATRICES) or plain
        focal, rest = _focal([listed[i] for i in (0, 2, 1, 3)] if loris and len(listed) == 4 else listed)
        lens = lens or rest
    if len(focal) != 4 or not all(np.isfinite(focal)):
        return None
    read, factor = Origin("", f"read from {path}"), _numbers(text, UNITS)[:1]
    stated = [n for key in ("w(?:idth)?", "h(?:eight)?") for n in _numbers(text, rf"(?:\w*[._])?{key}")[:1]]
    stated = stated or _numbers(text, "(?:image_size|resolution|size)")
    width, height = map(int, stated) if len(stated) == 2 and min(stated) > 1 else size
    camera = build_camera(path, width, height, focal)
    if width * size[1] == height * size[0]:
        camera = camera.resized(*size)
    origins = {"camera": read} | ({"depth unit": read} if factor else {})
    distortion = tuple([*lens, 0.0, 0.0, 0.0, 0.0, 0.0][:5]) if any(lens) else None
    return Calibration(camera, (factor or [units])[0], distortion, origins=origins)


def _numbers(text: str, key: str) -> list[float]:
    """Return the numbers after a key, in brackets or single, of YAML or JSON; `data` of an OpenCV or ROS matrix."""
    listed = rf"([\[\]\s,]*{NUMBER}(?:[\s,\]\[]+{NUMBER})*)"
    found = re.search(rf"(?:^|[\s,{{\"']){key}{OPENED}{listed}", text)
    single = found and "[" not in found[1]
    numbers = [float(word) for word in re.findall(NUMBER, found[1])] if found else []
    return numbers[:1] if single else numbers


def _focal(numbers: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return fx, fy, cx, cy of a matrix by rows or by columns, or of a list; and what follows in a list, the lens."""
    matrix = np.array(numbers[: 16 if len(numbers) == 16 else 9])
    if len(matrix) in (9, 16):
        K = matrix.reshape(round(len(matrix) ** 0.5), -1)
        for rows in (K, K.T):
            if rows[0, 0] > 1.0 < rows[1, 1] and not rows[1, 0] and not any(rows[2, :2]) and rows[2, 2] == 1.0:
                return [float(rows[0, 0]), float(rows[1, 1]), float(rows[0, 2]), float(rows[1, 2])], []
    usable = len(numbers) in (4, 8, 9) and min(numbers[:2], default=0.0) > 1.0
    return (list(numbers[:4]), list(numbers[4:])) if usable else ([], [])
