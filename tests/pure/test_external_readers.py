"""Maps in every format, read by other programs, and theirs read by us. Skipped where these are not installed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import exit_code
from external_readers import convert, package, read_by_splat_transform, script
from sigmasplat.data.field import GaussianField, Rows
from sigmasplat.data.harmonics import count
from sigmasplat.plugins.outputs.splats import gltf, sog
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.splat_values import SplatValues
from sigmasplat.uncertainty.map_uncertainty import SplatStd

VALIDATE = """
import {readFileSync} from 'fs'; import validator from 'gltf-validator';
const found = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[1])));
console.log(JSON.stringify(found));
"""
ATTRIBUTES = """
import {NodeIO} from '@gltf-transform/core';
const io = new NodeIO(), root = (await io.read(process.argv[1])).getRoot();
const primitive = root.listMeshes()[0].listPrimitives()[0], found = {};
for (const name of primitive.listSemantics()) found[name] = Array.from(primitive.getAttribute(name).getArray());
console.log(JSON.stringify({mode: primitive.getMode(), found}));
"""


def splats(n: int = 60, degree: int = 3) -> GaussianField:
    """Splats a few metres away; colours, opacities and harmonics within what every format can hold."""
    random = torch.Generator().manual_seed(0)
    params = torch.randn(n, 17, generator=random)
    params[:, 2] += 4.0
    params[:, 7:10] = 0.4 * params[:, 7:10] - 4.0
    params[:, 11:14] = torch.rand(n, 3, generator=random)
    params[:, 14:17] = params[:, 14:17] * 0.3 - 5.0
    field = GaussianField(params)
    if degree:
        harmonics = torch.zeros(n, 45)
        harmonics[:, : 3 * count(degree)] = 0.1 * torch.randn(n, 3 * count(degree), generator=random)
        field.attributes["harmonics"] = Rows(harmonics)
    return field


def matched(found: SplatValues, like: SplatValues) -> SplatValues:
    """Reorder splats like others, by position."""
    distances = np.linalg.norm(found.means[None] - like.means[:, None], axis=2)
    rows = distances.argmin(1)
    assert sorted(rows) == list(range(len(like)))
    return found.ordered(rows)


def cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return |cos| of half the angle between rotations; half a turn about an axis of a splat does not change it."""
    w, x, y, z = b.T
    same = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    return np.max([np.abs((a * np.stack(q, axis=1)).sum(1)) for q in same], axis=0)


def assert_same(
    found: SplatValues, like: SplatValues, means: float = 1e-5, log_scales: float = 1e-4, color: float = 1e-4,
    rotation: float = 1e-6, harmonics: float = 1e-5,
) -> None:  # fmt: skip
    """Compare two maps; the tolerances are absolute, of rotations that of 1 − |cos| of half the angle."""
    found = matched(found, like)
    assert np.abs(found.means - like.means).max() <= means
    assert np.abs(found.log_scales - like.log_scales).max() <= log_scales
    assert np.abs(found.colors - like.colors).max() <= color
    assert np.abs(found.opacities - like.opacities).max() <= max(color, 1e-5)
    assert (1.0 - cosines(found.quats, like.quats)).max() <= rotation
    assert found.harmonics.shape == like.harmonics.shape
    assert np.abs(found.harmonics - like.harmonics).max(initial=0.0) <= harmonics


TOLERANCES: dict[str, dict[str, float]] = {
    ".ply": {},
    ".sog": {"means": 1e-3, "log_scales": 0.02, "color": 4e-3, "rotation": 1e-4, "harmonics": 0.05},
    ".3.spz": {"means": 2e-4, "log_scales": 0.04, "color": 4e-3, "rotation": 1e-5, "harmonics": 5e-3},
}
"""About half a step of each format's quantisation, in the coarsest part of its range."""


@pytest.fixture
def exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a map as PLY in its own axes."""
    monkeypatch.chdir(tmp_path)
    ply.write_field(tmp_path / "map.ply", splats())
    return tmp_path / "map.ply"


@pytest.mark.parametrize("ending", [".ply", ".sog", ".3.spz"])
def test_splat_transform_reads_what_we_export_the_same_way_up(exported: Path, ending: str) -> None:
    package("@playcanvas/splat-transform")
    assert exit_code("export", "map.ply", "--out", f"out{ending}") == 0
    found = read_by_splat_transform(exported.with_name(f"out{ending}"), exported.parent)
    assert_same(found, SplatValues.of(splats()), **TOLERANCES[ending])


@pytest.mark.parametrize("axes", ["y-up", "z-up", "y-down", "camera"])
def test_axes_of_a_ply_are_those_of_its_coordinates(exported: Path, axes: str) -> None:
    """A map without a path is not levelled. y-up coordinates of a PLY are those that an SPZ file has."""
    package("@playcanvas/splat-transform")
    assert exit_code("export", "map.ply", "--out", "out.ply", "--axes", axes) == 0
    found = read_by_splat_transform(exported.with_name("out.ply"), exported.parent)
    to_axes = {"y-up": np.diag([1, -1, -1]), "z-up": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])}
    T = np.eye(4)
    T[:3, :3] = to_axes.get(axes, np.eye(3))
    assert_same(found, SplatValues.of(splats().moved(torch.from_numpy(T))))


def test_we_read_the_ply_of_splat_transform(exported: Path) -> None:
    written = convert(exported, exported.with_name("theirs.ply"))
    assert_same(SplatValues.of(ply.read_field(written)), SplatValues.of(splats()), **TOLERANCES[".ply"])


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_validator_of_khronos_finds_no_other_fault(tmp_path: Path, degree: int) -> None:
    package("gltf-validator")
    gltf.write_field(tmp_path / "a.glb", splats(degree=degree), std=std())
    found = script(VALIDATE, tmp_path / "a.glb")
    known = "/attributes/KHR_gaussian_splatting:"  # the published validator does not know attributes of extensions
    problems = [each for each in found["issues"]["messages"] if each["severity"] < 2 and known not in each["pointer"]]
    assert problems == [] and found["info"]["totalVertexCount"] == 60


def std() -> SplatStd:
    return SplatStd(torch.linspace(0.01, 0.1, 60), torch.linspace(0.1, 0.2, 60))


def test_gltf_transform_reads_splats_and_sigma(tmp_path: Path) -> None:
    package("@gltf-transform/core")
    field, name = splats(), "KHR_gaussian_splatting"
    gltf.write_field(tmp_path / "a.glb", field, std=std())
    read = script(ATTRIBUTES, tmp_path / "a.glb")
    found = {key: np.array(values).reshape(60, -1) for key, values in read["found"].items()}
    assert read["mode"] == 0
    means, scales = field.means.numpy() * [1.0, -1.0, -1.0], field.scales.numpy()
    np.testing.assert_allclose(found["POSITION"], means, atol=1e-6)
    np.testing.assert_allclose(found[f"{name}:SCALE"], scales, rtol=1e-5)
    np.testing.assert_allclose(found[f"{name}:OPACITY"][:, 0], field.opacities, atol=1e-6)
    np.testing.assert_allclose(found["_SIGMA"], field.variances.sqrt(), rtol=1e-5)
    np.testing.assert_allclose(found["_DEPTH_STD_M"][:, 0], std().depth_std_m, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found[f"{name}:ROTATION"], axis=1), 1.0, atol=1e-6)
    assert sum(key.startswith(f"{name}:SH_DEGREE_3") for key in found) == 7


def test_sog_has_the_images_that_its_readers_expect(tmp_path: Path) -> None:
    """splat-transform's own file of the same map has the same members and keys."""
    import json
    import zipfile

    ply.write_field(tmp_path / "a.ply", splats())
    sog.write_field(tmp_path / "ours.sog", splats())
    both = [
        zipfile.ZipFile(path) for path in (convert(tmp_path / "a.ply", tmp_path / "theirs.sog"), tmp_path / "ours.sog")
    ]
    assert sorted(both[0].namelist()) == sorted(both[1].namelist())
    theirs, ours = (json.loads(archive.read("meta.json")) for archive in both)
    assert ours.keys() == theirs.keys()
    for key in ("means", "scales", "quats", "sh0", "shN"):
        assert ours[key].keys() == theirs[key].keys() and ours[key]["files"] == theirs[key]["files"]
