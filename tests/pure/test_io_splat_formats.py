"""Compressed maps: image quality for their size, and every byte as the formats' layouts define it."""

import gzip
import itertools
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_readers import from_smallest_three, read_any

from room_map import psnr_db, room_map
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.errors import RunError
from sigmasplat.plugins.outputs import spz
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.splat_values import SplatValues, morton_order, smallest_three

Writer = Callable[[Path, GaussianField], None]
WRITERS: dict[str, Writer] = {
    ".ply": ply.write_field,
    ".spz": spz.write_field,
}


def again(path: Path, field: GaussianField) -> GaussianField:
    """Write a field in the format of the path's ending, and read it from a file without an ending."""
    WRITERS[path.suffix](path, field)
    return read_any(path.rename(path.with_name("map")))


def some(n: int = 300, degree: int = 0, seed: int = 0) -> GaussianField:
    random = torch.Generator().manual_seed(seed)
    params = torch.randn(n, 17, generator=random)
    params[:, 7:10] -= 4.0
    params[:, 11:14] = torch.rand(n, 3, generator=random)
    field = GaussianField(params)
    if degree:
        k = torch.zeros(n, 45)
        k[:, : 3 * count(degree)] = (0.3 * torch.randn(n, 3 * count(degree), generator=random)).clamp(-0.99, 0.99)
        field.attributes["harmonics"] = Rows(k)
    return field


def nearest(values: SplatValues, to: SplatValues) -> SplatValues:
    """Reorder values like those of `to`, by position."""
    distances = np.linalg.norm(values.means[None] - to.means[:, None], axis=2)
    return values.ordered(distances.argmin(1))


@pytest.mark.parametrize("degree", [0, 3])
def test_ply_gives_the_same_render(tmp_path: Path, degree: int) -> None:
    field = room_map(degree)
    assert psnr_db(again(tmp_path / "a.ply", field), field) > 60.0
    ply.write_field(tmp_path / "plain.ply", field, plain=True)
    assert psnr_db(read_any(tmp_path / "plain.ply"), field) > 60.0


@pytest.mark.parametrize("degree", [0, 3])
def test_a_quarter_of_the_size_gives_nearly_the_same_render(tmp_path: Path, degree: int) -> None:
    field = room_map(degree)
    back = again(tmp_path / "a.spz", field)
    ply.write_field(tmp_path / "a.ply", field)
    assert (tmp_path / "map").stat().st_size <= (tmp_path / "a.ply").stat().st_size / 4
    assert len(back) == len(field) and psnr_db(back, field) > 35.0


def test_values_that_spz_cannot_hold_are_as_in_a_new_map(tmp_path: Path) -> None:
    back = again(tmp_path / "a.spz", some())
    assert (back.params[:, 14:17] == -7.0).all() and not back.attributes


def test_harmonics_are_kept_to_half_a_quantisation_step(tmp_path: Path) -> None:
    for degree in [1, 2, 3]:
        field = some(40, degree)
        back, was = SplatValues.of(again(tmp_path / "a.spz", field)), SplatValues.of(field)
        assert back.degree == degree == was.degree
        assert np.abs(nearest(back, was).harmonics - was.harmonics).max() <= 0.5 / 128 + 1e-6


@pytest.mark.parametrize("ending", list(WRITERS))
def test_the_same_map_gives_the_same_bytes_and_no_other_files(tmp_path: Path, ending: str) -> None:
    for name in ("a", "b"):
        WRITERS[ending](tmp_path / f"{name}{ending}", some(300, 1))
    assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2
    with pytest.raises(RunError, match="cannot write"):
        WRITERS[ending](tmp_path / "none" / "a", some())


def test_maps_of_any_number_of_splats(tmp_path: Path) -> None:
    for n, ending in itertools.product([0, 1, 256, 257], WRITERS):
        assert len(again(tmp_path / f"a{ending}", some(n))) == n


def test_extremes_stay_finite(tmp_path: Path) -> None:
    """Opacities of 0 and 1, colours outside [0, 1], needles, identical splats: all values stay finite."""
    field = some(8)
    field.params[0, 10], field.params[1, 10] = 60.0, -60.0
    field.params[2, 11:14] = torch.tensor([-3.0, 0.0, 4.0])
    field.params[3, 7:10] = torch.tensor([-90.0, 3.0, -90.0])
    field.params[4:, :10] = field.params[4, :10].clone()
    back = again(tmp_path / "a.spz", field)
    assert torch.isfinite(back.params).all() and torch.isfinite(back.scales).all()
    assert back.opacities.max() > 0.998 and back.opacities.min() < 0.002


def test_spz_has_the_documented_layout(tmp_path: Path) -> None:
    """Decode a file splat by splat; its map is rotated by 180° about x, as by `GaussianField.moved`."""
    for degree in [0, 1, 2, 3]:
        field = some(50, degree)
        spz.write_field(tmp_path / "a.spz", field)
        data = gzip.decompress((tmp_path / "a.spz").read_bytes())
        each = 3 * count(degree)
        assert struct.unpack_from("<IIIBBBB", data) == (0x5053474E, 3, 50, degree, 12, 0, 0)
        assert len(data) == 16 + 50 * (20 + each)
        was = SplatValues.of(field.moved(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))))
        at = [16 + 50 * offset for offset in (0, 9, 10, 13, 16, 20)]
        for i in range(50):
            mean = [int.from_bytes(data[at[0] + 9 * i + 3 * k :][:3], "little", signed=True) / 4096 for k in range(3)]
            row = int(np.linalg.norm(was.means - mean, axis=1).argmin())
            assert np.abs(was.means[row] - mean).max() <= 0.5 / 4096 + 1e-6
            assert abs(data[at[1] + i] / 255 - was.opacities[row]) < 0.5 / 255 + 1e-6
            colors = [(b / 255 - 0.5) / 0.15 * 0.28209479 + 0.5 for b in data[at[2] + 3 * i :][:3]]
            assert np.abs(was.colors[row] - colors).max() < 0.5 / 255 / 0.15 * 0.2821 + 1e-6
            assert np.abs(was.log_scales[row] - [b / 16 - 10 for b in data[at[3] + 3 * i :][:3]]).max() <= 1 / 32 + 1e-6
            (word,) = struct.unpack_from("<I", data, at[4] + 4 * i)
            xyzw = [(-1) ** (word >> s + 9 & 1) * (word >> s & 511) / 511 * math.sqrt(0.5) for s in (20, 10, 0)]
            xyzw.insert(word >> 30, math.sqrt(1 - sum(q * q for q in xyzw)))
            w, x, y, z = was.quats[row]
            assert abs(np.dot(xyzw, (w, z, -y, -x))) > 1 - 1e-5, (
                "turned axes, not a turned splat: half a turn about its x less"
            )
            k = [(b - 128) / 128 for b in data[at[5] + each * i :][:each]]
            assert np.abs(np.array(k) - was.harmonics[row]).max(initial=0) <= 0.5 / 128 + 1e-5


def test_a_splat_too_far_for_spz_is_refused(tmp_path: Path) -> None:
    field = some(100)
    field.params[:, :3] *= 20_000.0
    with pytest.raises(RunError, match="SPZ holds at most 2048 m"):
        spz.write_field(tmp_path / "a.spz", field)


def test_morton_order_keeps_neighbours_together() -> None:
    points = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)[np.random.default_rng(0).permutation(512)]
    order = morton_order(points)
    assert sorted(order) == list(range(512))
    assert all(np.ptp(points[order[i : i + 8]], axis=0).max() <= 1.0 for i in range(0, 512, 8)), (
        "each group of eight is a cube"
    )
    assert morton_order(np.zeros((3, 3))).tolist() == [0, 1, 2] and len(morton_order(np.empty((0, 3)))) == 0


def test_the_smallest_three_components_determine_the_rotation() -> None:
    quats = np.random.default_rng(0).normal(size=(200, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    which, others = smallest_three(quats)
    assert np.abs(others).max() <= math.sqrt(0.5) and set(which) == {0, 1, 2, 3}
    np.testing.assert_allclose(np.abs((from_smallest_three(which, others) * quats).sum(1)), 1.0)
