"""Read the intrinsics that other programs leave beside the images, as text, YAML or JSON, under their usual names."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sigmasplat.config import InputConfig
from sigmasplat.files.reading import open_regular
from sigmasplat.input.calibration import MEASURED, Calibration, Origin, build_camera, own_calibration

NAMES = re.compile(
    r"((scene_)?cam(era)?s?(_matrix)?|colou?r|rgb|calib\w*|sensors|_?info|ost|k|tum\d|focal"
    r"|(\w*[-_])?(intrinsics?|camera_info|cam(era)?_k)(_\w+)?)"
)
"""Names of files, without their ending: of ROS, kalibr, ORB-SLAM, BOP, 3DMatch, SUN3D, OpenLORIS and others. Files of
other names count if they name fx, fy, cx and cy."""
OPENLORIS = r"(?ms)^d400_color_optical_frame:(.*?)(?=^\S|\Z)"
COLOR = r"(?s)\b(?:rgb|colou?r)\w*[\"']?[ \t]*:[ \t]*[{\n](.*(?:fx|fl_x|matrix|intrinsic|cam_k).*)"
"""The colour camera beside that of depth: OpenLORIS's, whose intrinsics are in the order fx, cx, fy, cy; and others."""
FOCAL = "(?:fx|fl_x|focallengthx)", "(?:fy|fl_y|focallengthy)", "(?:c|pp|principalpoint)x", "(?:c|pp|principalpoint)y"
COLMAP = r"(?m)^\d+ (?:pinhole|opencv|(simple)_\w+) (\d+ \d+) (.*)$"
"""A camera of COLMAP; its pixels have their centre at ½."""
ENDINGS = (".txt", ".yaml", ".yml", ".json", ".csv", ".cfg")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MATRICES = r"(?:m_calibrationcolorintrinsic|camera_matrix|cam_k|intrinsic_matrix|intrinsics?|k)"
LENSES = r"(?:distortion(?:_coefficients|_coeffs)?|dist(?:_?coeffs?)?|coeffs|d)"
UNITS = r"(?:\w*\.)?(?:depthmapfactor|png_depth_scale|depth_map_factor|depth_scale|m_depthshift)"
SIZED = r"[\"']?(?:rows|cols|dt)[\"']?\s*:\s*\w+[,\s]*"
OPENED = rf"[\"']?\s*[:=]\s*(?:!!opencv-matrix\s*)?\{{?\s*(?:{SIZED})*(?:[\"']?data[\"']?\s*:\s*)?"
"""What is between a key and its numbers in YAML and JSON: nothing more than a colon, or the head of a matrix."""
MOST_BYTES, MOST_FILES, SAME_SHAPE, CENTRED = 1 << 16, 20, 0.02, 0.2
Size = tuple[int, int]


def intrinsics_beside(folder: Path, settings: InputConfig, size: Size, units: float) -> Calibration | None:
    """Return the calibration in the first such file of a folder that holds a camera for images of (width, height);
    None without one, and if there is a calibration.json: the lens of one file must not join the camera of another.
    units: of depth, if the file has none."""
    if settings.calibration or own_calibration(folder):
        return None
    files = [p for place in (folder, folder / "sparse/0") if place.is_dir() for p in sorted(place.iterdir())]
    files = [path for path in files if path.suffix.lower() in ENDINGS and path.is_file()]
    for path in sorted(files, key=lambda path: not NAMES.fullmatch(path.stem.lower()))[:MOST_FILES]:
        if found := read_intrinsics(path, size, units):
            return found
    return None


def read_intrinsics(path: Path, size: Size, units: float) -> Calibration | None:
    """Return the calibration in a file, None if it holds no camera; arguments as for `intrinsics_beside`."""
    with open_regular(path) as file:  # a file with the cameras of all frames begins with the first
        text = re.sub(r"(?m)#.*$", "", file.read(MOST_BYTES).decode("utf-8", "replace")).lower()
    loris, scale = re.search(OPENLORIS, text), [n for n in _numbers(text, "scale") if n >= 100]  # NICE-SLAM's
    factor = [n for n in _numbers(text, UNITS)[:1] if n > 0] or scale
    if part := loris or re.search(COLOR, text):
        text = part[1]

    def single(*keys: str) -> list[float]:
        return [number for key in keys for number in _numbers(text, rf"(?:\w*[._])?{key}")[:1]]

    focal, lens = single(*FOCAL), _numbers(text, LENSES)[:5]
    lens = lens if len(lens) > 3 else single("k1", "k2", "p1", "p2", "k3")
    stated = single("(?:m_color)?w(?:idth)?", "(?:m_color)?h(?:eight)?")
    stated = stated or _numbers(text, "(?:image_size|resolution|size)")
    if colmap := re.search(COLMAP, text):
        stated, listed = ([float(word) for word in re.findall(NUMBER, colmap[i])] for i in (2, 3))
        focal = [*listed[:1], *listed] if colmap[1] else listed
        focal, lens = [n - 0.5 * (i > 1) for i, n in enumerate(focal[:4])], focal[4:]
    if len(focal) != 4 and NAMES.fullmatch(path.stem.lower()):
        plain = [float(word) for word in re.findall(NUMBER, text)] if not re.search(r"[a-df-z]", text) else []
        if path.stem.lower() == "focal" and len(plain) == 1:
            plain = [*plain, *plain, (size[0] - 1) / 2, (size[1] - 1) / 2]
        listed = _numbers(text, MATRICES) or plain
        focal, rest = _focal([listed[i] for i in (0, 2, 1, 3)] if loris and len(listed) == 4 else listed)
        lens = lens or rest
    if len(focal) != 4 or not all(np.isfinite(focal)):
        return None
    read = Origin("", f"read from {path}")
    origins = {"camera": read} | ({"depth unit": read} if factor else {})
    if len(stated) != 2 or min(stated) <= 1:
        stated = [*map(float, _size_of(size, focal))]
        origins["size of the calibration"] = Origin("{:g}×{:g}, which has the nearest centre".format(*stated), MEASURED)
    width, height = map(int, stated)
    camera = build_camera(path, width, height, focal)
    if abs(width * size[1] - height * size[0]) <= SAME_SHAPE * height * size[0]:
        camera = camera.resized(*size)
    distortion = tuple([*lens, 0.0, 0.0, 0.0, 0.0, 0.0][:5]) if any(lens) else None
    if factor:  # RealSense states metres per unit, BOP mm per unit
        units = factor[0] if factor[0] >= 10 else round((1 if factor[0] < 0.01 else 1000) / factor[0], 3)
    return Calibration(camera, units, distortion, origins=origins)


def _size_of(size: Size, focal: Sequence[float]) -> Size:
    """Return the size of the images that intrinsics without a size belong to: the one whose centre is nearest, of
    (width, height), its multiples and ScanNet's colour images."""
    sizes = [(round(size[0] * k), round(size[1] * k)) for k in (1, 0.5, 2, 3, 4, 6, 8)] + [(1296, 968)]
    off = {s: max(abs(2 * focal[i + 2] + 1 - s[i]) / s[i] for i in range(2)) for s in sizes}
    found = min(sizes, key=off.__getitem__)
    return found if off[found] < CENTRED else size


def _numbers(text: str, key: str) -> list[float]:
    """Return the numbers after a key, in brackets or single, of YAML or JSON; `data` of an OpenCV or ROS matrix."""
    listed = rf"([\[\]\s,]*{NUMBER}(?:[\s,\]\[]+{NUMBER})*)"
    found = re.search(rf"(?:^|[\s,{{\"']){key}{OPENED}{listed}", text)
    numbers = [float(word) for word in re.findall(NUMBER, found[1])] if found else []
    return numbers[:1] if found and "[" not in found[1] and len(numbers) != 16 else numbers


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
