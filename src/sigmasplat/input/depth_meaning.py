"""Find out what depth images hold: depth along the optical axis (z), distance along the ray, or inverse depth; and
whether their largest value is no reading.

1/z of a plane is affine in the pixel; so is |ray|/d for distance d along the ray, and inverse depth as it is. Let e be
what an affine fit to 1/value leaves in a window, and t its change if the value is divided by |ray|. Then e + s·t = 0
gives the share s of each window on a smooth surface: 0 for z, 1 along the ray. In the same way, the square of the value
gives a share that is 1 for z and 0 for inverse depth. Surfaces that bend give any share.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.input.calibration import ALONG_RAY, ASSUMED, GIVEN, MEASURED, Origin

SAMPLES, MOST_PIXELS = 8, 2_500_000
"""Number of images that are looked at; of large ones as many as have so many pixels, but three."""
COLUMNS, WINDOWS, MOST_HOLES = 160, (5, 8), 0.3
"""Width of the thinned images; windows have these parts of it, and at most this share of holes."""
SMOOTH, SURE_WINDOW, BENT, FLOOR, ALIKE = 0.02, 0.5, 1e-4, 0.1, 6.0
"""A window counts if its relative residual and the deviation of its share are below these. Rounding, lenses and sensors
bend planes by BENT of their distance; no share is better than FLOOR. Windows overlap: ALIKE of them count as one."""
LEVEL, NEAR, FEWEST = 2.5, 0.4, 20
"""Sure: so many standard errors from 0.5, so near to 0 or 1, by so many windows. On 8 images of 7-Scenes, TUM, HoloLens
and rendered rooms, the share is −0.1 to 0.1, and 0.85 to 1.05 if they are made to distance along the ray."""
SPIKE, PEAK, NEAR_MAX, MOVED = 0.005, 5.0, 0.7, 1.05
"""A spike: the largest value has this share of the readings, in three images, and this multiple of the readings of any
other value above NEAR_MAX of it. Sure: it is round, and the medians of the other readings differ by MOVED, because a
wall that is parallel to the image has one value too, until the camera moves."""
INVERSE = (
    "planes show that depth is stored as inverse depth (disparity), which grows with nearness; export metres, or give "
    "the folder of the depth images: --predicted-depth FOLDER --predicted-inverse"
)
NORMALISED = (
    "the largest value of every image is 1, so depth is normalised, not in metres; if 1 is the same distance in all, "
    "such as 10 m: --depth-scale 0.1; otherwise give the folder of the depth images: --predicted-depth FOLDER"
)

Values = NDArray[np.float64]
Image = NDArray[np.float32]


class Meaning(NamedTuple):
    """Whether depth is distance along the ray, from which value on, m, it is no reading; origins, and what is wrong."""

    ray: bool
    beyond_m: float
    origins: dict[str, Origin]
    doubts: list[str]


def thinned(depth_m: Image) -> Image:
    """Return every n-th pixel of an image [H, W], about `COLUMNS` columns."""
    step = max(1, depth_m.shape[1] // COLUMNS)
    return depth_m[step // 2 :: step, step // 2 :: step].copy()


def ends_at_one(depth_m: Image) -> bool:
    """Return whether float depth [H, W] ends at exactly 1, and not in whole millimetres: a scene that is cut off at 1 m
    ends a little before it, unless its readings are rounded."""
    millimetres = 1000 * depth_m
    return abs(float(depth_m.max()) - 1) < 1e-6 and bool((np.abs(millimetres - np.rint(millimetres)) > 0.01).any())


def meaning_of(images: Sequence[Image], camera: Camera, units_per_metre: float, settings: InputConfig) -> Meaning:
    """Return what the values of thinned depth images, m, mean. Without images it is what `depth_along` says.

    camera: of the whole images, without lens distortion.
    """
    along = settings.depth_along
    most, share, sure = spike_of(images, units_per_metre)
    known, doubts = dict[str, Origin](), list[str]()
    if share:
        words = f"{share:.1%} of the readings have exactly the largest value, {most:.3f} m"
        images = [np.where(image < most, image, np.float32(0.0)) for image in images]
        if sure:
            dropped = f"{words}; these and larger ones are dropped (--set input.depth_along=z keeps them)"
            known["farthest depth"] = Origin(dropped, MEASURED)
        elif most <= settings.max_depth_m:
            doubts.append(f"{words}; if these are no readings: --set input.max_depth_m={0.999 * most:.3f}")
    is_ray, origin = along == "ray", GIVEN
    if along == "auto":
        ray, inverse = shares_of(images, camera) if images else (np.nan, np.nan)
        is_ray, origin = ray == 1 and inverse != 1, MEASURED if ray in (0, 1) and inverse != 1 else ASSUMED
        doubts += [INVERSE] * (inverse == 1)
    option = "--set input.depth_along=ray" if origin == ASSUMED else ""
    value = ALONG_RAY if is_ray else "along the optical axis"
    return Meaning(is_ray, most if sure else np.inf, known | {"depth": Origin(value, origin, option)}, doubts)


def spike_of(images: Sequence[Image], units_per_metre: float) -> tuple[float, float, bool]:
    """Return the largest value of thinned depth images, m, the share of the readings that have it, 0 without a spike,
    and whether these are surely no readings."""
    readings = np.concatenate([np.zeros(0), *(image[image > 0] for image in images)])
    most = readings.max(initial=0.0)
    rest = [image[(image > 0) & (image < most)] for image in images if (image == most).mean() > SPIKE / 5]
    count = (readings == most).sum()
    _, others = np.unique(readings[(readings >= NEAR_MAX * most) & (readings < most)], return_counts=True)
    if len(rest) < 3 or count < max(SPIKE * len(readings), PEAK * others.max(initial=0)) or not all(map(len, rest)):
        return most, 0.0, False
    medians, units = [float(np.median(image)) for image in rest], round(most * units_per_metre)
    all_ones = units > 200 and units & (units + 1) == 0  # 255, 4095, …
    is_round = all_ones or abs(20 * most - round(20 * most)) < 0.012
    return most, float(count / len(readings)), is_round and max(medians) > MOVED * min(medians)


def shares_of(images: Sequence[Image], camera: Camera) -> tuple[float, float]:
    """Return the share of distance along the ray and that of inverse depth: 0 or 1 if it is sure, otherwise NaN."""
    lengths = thinned(camera.ray_lengths())
    found = [_shares(image, lengths, max(4, lengths.shape[1] // part)) for part in WINDOWS for image in images]
    ray, z = np.concatenate(found, -1)
    return _pooled(*ray), 1.0 - _pooled(*z)


def _shares(image: Image, lengths: Image, size: int) -> Values:
    """Return both shares of each window of size² pixels, their deviations and the relative residuals [2, 3, N]."""
    if min(lengths.shape) < size:
        return np.zeros((2, 3, 0))
    every = max(1, size // 2)
    views = (sliding_window_view(each, (size, size))[::every, ::every] for each in (image, lengths))
    value, length = (view.reshape(-1, size**2).astype(np.float64) for view in views)
    kept = (value > 0).mean(1) >= 1.0 - MOST_HOLES
    value, length, valid = value[kept], length[kept], value[kept] > 0
    count = valid.sum(1)
    rows, columns = np.mgrid[:size, :size].reshape(2, -1) / size - 0.5
    affine = np.stack([np.ones(size**2), rows, columns], 1)
    normal = (valid @ (affine[:, :, None] * affine[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)

    def left(y: Values) -> Values:
        fitted = np.linalg.solve(normal, ((y * valid) @ affine)[..., None])[..., 0] @ affine.T
        return np.asarray((y - fitted) * valid)

    def share(e: Values, t: Values) -> Values:
        power = (t * t).sum(1) + 1e-30
        s = -(e * t).sum(1) / power
        residual = np.sqrt(((e + s[:, None] * t) ** 2).sum(1) / count)
        return np.stack([s, np.sqrt((residual**2 + BENT**2 * count) / power), residual])

    relative = value / (value.sum(1) / count)[:, None]
    inverse = np.divide(1.0, relative, out=np.zeros_like(relative), where=valid)
    e, longer = left(inverse), left(inverse * length / length.mean(1, keepdims=True))
    return np.stack([share(e, longer - e), share(left(relative), -left((relative - 1.0) ** 2))])


def _pooled(shares: Values, deviations: Values, residuals: Values) -> float:
    """Return 0 or 1 as the weighted median of the windows [N] says, NaN if that is not sure."""
    used = (residuals < SMOOTH) & (deviations < SURE_WINDOW) & (np.abs(shares - 0.5) < 1.5)
    if used.sum() < FEWEST:
        return float("nan")
    shares, weights = shares[used], 1.0 / (deviations[used] ** 2 + FLOOR**2)
    middle = _median(shares, weights)
    spread = np.hypot(1.4826 * _median(np.abs(shares - middle), weights), FLOOR)
    error = 1.25 * spread * np.sqrt(ALIKE * (weights**2).sum()) / weights.sum()
    answer = float(middle > 0.5)
    return answer if abs(middle - 0.5) > LEVEL * error and abs(middle - answer) < NEAR else float("nan")


def _median(values: Values, weights: Values) -> float:
    order = values.argsort()
    passed = weights[order].cumsum()
    return float(values[order][np.searchsorted(passed, passed[-1] / 2)])
