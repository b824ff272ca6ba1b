"""The built-in descriptor: what must not matter to it, what must, and whether it knows a place again."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sigmasplat.data.frame import Frame
from sigmasplat.input.opening import open_source
from sigmasplat.tracking.descriptors import Descriptor, OrientationGrid, similarity

GRID: Descriptor = OrientationGrid()


@cache
def frame(index: int = 0) -> Frame:
    """Views of the synthetic room; 0 and 3 show one place, 40 and 80 others."""
    return open_source("synthetic:frames=120,width=160,height=120,noise=1").frame(index)


def described(color: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    return GRID.describe(color.astype(np.float32), depth_m.astype(np.float32))


def alike(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> float:
    return float(described(*a) @ described(*b))


def view(index: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return frame(index).color, frame(index).depth_m


def test_a_descriptor_is_float32_of_unit_norm_and_one_length_whatever_the_size() -> None:
    lengths = set()
    for size in ((120, 160), (60, 80), (37, 53), (480, 640)):
        f = frame().resized(size[1], size[0])
        d = GRID.describe(f.color, f.depth_m)
        assert d.dtype == np.float32 and d.ndim == 1
        assert np.linalg.norm(d) == pytest.approx(1.0, abs=1e-6)
        lengths.add(len(d))
    assert lengths == {2 * 4 * 3 * 8}
    assert np.array_equal(described(*view()), described(*view()))


def test_size_hardly_matters() -> None:
    f = open_source("synthetic:frames=120,width=640,height=480").frame(0)
    small = f.resized(160, 120)
    assert alike((f.color, f.depth_m), (small.color, small.depth_m)) > 0.99


@pytest.mark.parametrize("gain", [0.2, 0.5, 0.9])
def test_exposure_does_not_matter(gain: float) -> None:
    color, depth = view()
    assert alike((color * gain, depth), (color, depth)) > 0.99999


def test_gamma_hardly_matters_nor_does_the_unit_of_depth() -> None:
    color, depth = view()
    assert alike((color**1.3, depth), (color, depth)) > 0.98
    assert alike((color, depth * 1.7), (color, depth)) > 0.9999


def holed(depth: np.ndarray, value: float = 0.0) -> np.ndarray:
    out = depth.copy()
    for row, column in ((0, 0), (50, 30), (70, 110), (10, 90)):
        out[row : row + 35, column : column + 40] = value
    return out


def test_missing_depth_is_no_value() -> None:
    color, depth = view()
    gray = np.full_like(color, 0.5)
    masked = alike((gray, holed(depth)), (gray, depth))
    filled = alike((gray, holed(depth, 0.2)), (gray, depth))
    assert masked > 0.8
    assert masked > filled + 0.1, "a hole must not look like a surface at some depth"


def test_a_flat_wall_full_of_holes_has_no_gradient() -> None:
    color, depth = view()
    wall = np.full_like(depth, 1.7)
    assert np.array_equal(described(color, holed(wall)), described(color, np.zeros_like(depth)))


def test_gray_stands_alone_where_there_is_no_depth_and_depth_where_it_is_dark() -> None:
    color, depth = view()
    half = len(described(color, depth)) // 2
    blind, dark = described(color, np.zeros_like(depth)), described(np.zeros_like(color), depth)
    both = described(color, depth)
    assert not blind[half:].any() and not dark[:half].any()
    np.testing.assert_allclose(blind[:half] * np.sqrt(0.65), both[:half], atol=1e-6)
    np.testing.assert_allclose(dark[half:] * np.sqrt(0.35), both[half:], atol=1e-6)


def test_nothing_to_see_is_like_nothing() -> None:
    color, depth = view()
    nothing = described(np.full_like(color, 0.4), np.zeros_like(depth))
    assert not nothing.any()
    assert similarity(nothing[None], described(color, depth)[None])[0, 0] == 0.0


def test_similarity_is_the_cosine_of_every_pair() -> None:
    random = np.random.default_rng(0)
    a, b = (random.normal(size=(n, 5)).astype(np.float32) for n in (3, 4))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    found = similarity(a, b)
    assert found.shape == (3, 4) and found.dtype == np.float64
    assert found[1, 2] == pytest.approx(float(a[1].astype(float) @ b[2].astype(float)))


def test_what_is_where_matters() -> None:
    color, depth = view()
    whole = (color, depth)
    assert alike((color[:, ::-1], depth[:, ::-1]), whole) < 0.9
    assert alike((color[::-1], depth[::-1]), whole) < 0.9
    assert alike(view(3), whole) > max(alike(view(40), whole), alike(view(80), whole)) + 0.05


def test_the_gradient_points_where_it_points() -> None:
    # A picture that brightens to the right has its whole energy in the bins around 0° (the last joins the first).
    ramp = np.broadcast_to(np.linspace(0.2, 0.9, 160, dtype=np.float32)[None, :, None] ** 2, (120, 160, 3))
    none = np.zeros((120, 160), np.float32)
    across = described(ramp, none)[:96].reshape(12, 8)
    assert (across.argmax(1) == 0).all() and (across[:, 4] < 0).all()
    down = described(np.linspace(0.2, 0.9, 120)[:, None, None] ** 2 * np.ones((1, 160, 3)), none)[:96].reshape(12, 8)
    assert (down.argmax(1) == 4).all()
    assert alike((ramp[:, ::-1], none), (ramp, none)) == pytest.approx(1.0, abs=1e-5), (
        "which side is brighter is nothing"
    )


def test_the_kitchen_is_recognised(data_folder: Callable[[str], Path]) -> None:
    """Every tenth frame: of the pairs far apart in time, the most alike show one place. Truth judges, here only."""
    source = open_source(data_folder("redkitchen"), stride=10)
    frames = [source.frame(i).prepared(160, 0.1, 8.0) for i in range(len(source))]
    truth = source.truth()
    assert truth is not None
    T = truth.T_world_camera[[int(np.abs(truth.timestamps_s - f.timestamp_s).argmin()) for f in frames]]
    metres = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    cosine = (np.einsum("iab,jab->ij", T[:, :3, :3], T[:, :3, :3]) - 1.0) / 2.0
    same = (metres < 0.5) & (cosine > np.cos(np.radians(40)))
    vectors = np.stack([GRID.describe(f.color, f.depth_m) for f in frames])
    apart = np.triu(np.ones_like(same), 10)  # more than 100 frames
    order = np.argsort(-similarity(vectors, vectors)[apart], kind="stable")
    hits = same[apart][order]
    precision = hits.cumsum() / np.arange(1, len(hits) + 1)
    assert hits.mean() < 0.2, "what chance alone would score"
    # Measured 0.84 and 0.61; a gray and depth thumbnail has 0.68 and 0.50. What is missed lies just beyond 0.5 m.
    assert precision[49] > 0.75, "precision of the fifty most alike pairs"
    assert (precision * hits).sum() / hits.sum() > 0.55, "average precision"
