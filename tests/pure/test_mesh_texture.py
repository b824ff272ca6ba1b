"""Textures of meshes: the right colours at the right places, and files that other programs read."""

import io
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera, exposed
from sigmasplat.data.field import GaussianField
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.data.submap import Picture
from sigmasplat.errors import RunError
from sigmasplat.final.fusion import FusionView, fuse, voxel_edge
from sigmasplat.plugins.outputs.mesh_files import write_mesh
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.types import no_progress

trimesh = pytest.importorskip("trimesh", reason="the [dev] extra is not installed")
pytest.importorskip("xatlas", reason="no wheel of xatlas for this machine")

from sigmasplat.plugins.outputs.mesh_texture import TexturedMesh, textured  # noqa: E402

SIZE = 256
CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
EXPOSURE = np.array([[1.25, 0.02], [0.8, 0.05], [1.1, -0.03]])


@pytest.fixture(autouse=True)
def small_atlas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sigmasplat.plugins.outputs.mesh_texture.SIZES", (SIZE, SIZE))


def paint(points: np.ndarray) -> np.ndarray:
    """Return the colour of points of the scene [N, 3], finer than its triangles."""
    x, y, _ = points.T
    return np.stack([0.5 + 0.3 * np.sin(25 * x), 0.5 + 0.3 * np.cos(25 * y), np.full(len(x), 0.4)], 1)


def sheet(edge: int = 12) -> Mesh:
    """Return a gently curved sheet of 1 m about z = 0 whose vertices are black."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.5, 0.5, edge + 1)] * 2, indexing="ij"))
    n = np.arange((edge + 1) ** 2).reshape(edge + 1, edge + 1)
    a, b, c, d = (part.ravel() for part in (n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    points = np.stack([x, y, 0.05 * np.sin(3 * x)], 1).astype(np.float32)
    return Mesh(points, faces, np.zeros_like(points), np.full(len(points), 0.01, np.float32))


def view(mesh: Mesh, x_m: float, exposure: np.ndarray | None = None) -> FusionView:
    """Return a view of the sheet, from 0.8 m in front of it and `x_m` beside its middle."""
    T = np.eye(4)
    T[:3, 3] = x_m, 0.0, -0.8
    depth_m, _ = mesh_depth(mesh, CAMERA, se3.inverse(T))
    points = (CAMERA.rays() * depth_m[..., None]).reshape(-1, 3) + T[:3, 3]
    color = paint(points).reshape(*depth_m.shape, 3).astype(np.float32)
    if exposure is not None:
        color = exposed(color, exposure)
    picture = Picture(np.rint(255 * color).astype(np.uint8), depth_m)
    return FusionView(GaussianField.empty(), CAMERA, se3.inverse(T), T, picture, exposure)


def made(views: list[FusionView]) -> TexturedMesh:
    return textured(sheet(), views, len(views), BASE, no_progress)


def errors(path: Path, left_of_m: float = 0.45) -> np.ndarray:
    """Read a GLB with trimesh; return the errors of its texture at random points of its faces, x below `left_of_m`."""
    (loaded,) = trimesh.load_scene(path, process=False).geometry.values()
    uv, image = loaded.visual.uv, np.asarray(loaded.visual.material.baseColorTexture.convert("RGB")) / 255.0
    assert uv.min() >= 0 and uv.max() <= 1 and image.shape == (SIZE, SIZE, 3)
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), (len(loaded.faces), 4))
    points, at = (np.einsum("fsk,fkc->fsc", shares, of[loaded.faces]) for of in (loaded.vertices, uv))
    inside = (np.abs(points[..., 1]) < 0.28) & (points[..., 0] > -0.45) & (points[..., 0] < left_of_m)
    column, row = np.floor(at[inside] * [1, -1] * SIZE).astype(int).T  # trimesh counts from the lower left corner
    return np.asarray(image[row % SIZE, column % SIZE] - paint(points[inside]))


def test_a_texture_shows_what_vertices_cannot(tmp_path: Path) -> None:
    views = [view(sheet(), -0.2), view(sheet(), 0.2, EXPOSURE)]
    write_mesh(tmp_path / "a.glb", made(views))
    off = errors(tmp_path / "a.glb")
    assert len(off) > 300 and np.sqrt((off**2).mean()) < 0.02, "also at the seam: the exposures are taken out"
    write_mesh(tmp_path / "b.glb", made(views))
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_what_moved_or_was_not_seen_has_the_colours_of_the_vertices(tmp_path: Path) -> None:
    passing = view(sheet(), 0.2)
    assert passing.picture is not None
    passing.picture.color[:], passing.picture.depth_m[:] = 255, 0.4
    write_mesh(tmp_path / "a.glb", made([view(sheet(), -0.4), passing]))
    assert np.sqrt((errors(tmp_path / "a.glb", 0.0) ** 2).mean()) < 0.02
    image = np.asarray(Image.open(io.BytesIO(made([passing]).image)))
    assert image.max() < 5, "the vertices are black, what passed by is white"


def test_usdz_is_aligned_and_valid(tmp_path: Path) -> None:
    mesh = made([view(sheet(), 0.0)])
    write_mesh(tmp_path / "a.usdz", mesh)
    data = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.testzip() is None and archive.namelist() == ["surface.usda", "texture.jpg"]
        for part in archive.infolist():
            name, extra = np.frombuffer(data, "<u2", 2, part.header_offset + 26)
            start = part.header_offset + 30 + int(name) + int(extra)
            assert part.compress_type == zipfile.ZIP_STORED and start % 64 == 0
            assert data[start : start + 8] == archive.read(part.filename)[:8]
    with pytest.raises(RunError, match="needs a surface with a texture"):
        write_mesh(tmp_path / "b.usdz", sheet())
    usd = pytest.importorskip("pxr", reason="needs usd-core, a reader of USDZ") and pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdValidation

    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Y"
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh"))
    np.testing.assert_allclose(shape.GetPointsAttr().Get(), mesh.vertices, atol=1e-6)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert validators and [error.GetMessage() for error in found] == []


def ball(away_m: float, noise_m: float) -> list[FusionView]:
    """Return noisy views of a ball of 12 cm radius at the origin, from all around, its surface `away_m` away."""
    random, views = np.random.default_rng(0), []
    for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        T = se3.exp(np.array([0, 0, 0, 0, angle, 0])) @ se3.exp(np.array([0, 0, -away_m - 0.12, 0, 0, 0]))
        rays = CAMERA.rays().astype(float)
        square, ahead = (rays**2).sum(-1), (away_m + 0.12) * rays[..., 2]
        under = ahead**2 - square * ((away_m + 0.12) ** 2 - 0.12**2)
        depth_m = np.where(under > 0, (ahead - np.sqrt(np.maximum(under, 0))) / square, 0.0)
        depth_m += (depth_m > 0) * noise_m * random.standard_normal(depth_m.shape)
        picture = Picture(np.full((*depth_m.shape, 3), 99, np.uint8), depth_m.astype(np.float32))
        views.append(FusionView(GaussianField.empty(), CAMERA, se3.inverse(T), T, picture))
    return views


def test_voxels_are_those_of_a_pixel_at_the_median_depth() -> None:
    near, far = voxel_edge(ball(0.4, 0.0), BASE), voxel_edge(ball(1.2, 0.0), BASE)
    assert near == pytest.approx(0.43 / CAMERA.fx, rel=0.1) and far == pytest.approx(1.23 / CAMERA.fx, rel=0.1)
    assert voxel_edge(ball(3.0, 0.0), BASE) == 0.01 == voxel_edge([], BASE), "at most 1 cm"


def test_memory_bounds_the_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sigmasplat.final.fusion.MOST_BLOCKS", 100)
    assert voxel_edge(ball(0.4, 0.0), BASE) > 1.5 * 0.43 / CAMERA.fx


def test_a_near_scan_is_right_within_two_millimetres() -> None:
    views = ball(0.4, 0.0013)

    def nothing(field: GaussianField, camera: Camera, T_camera_field: np.ndarray) -> Any:
        plane = torch.zeros(camera.height, camera.width)
        return SimpleNamespace(alpha=plane, depth=plane, color=plane[..., None].expand(-1, -1, 3))

    mesh = fuse(views, len(views), BASE, voxel_m=voxel_edge(views, BASE), renderer=nothing)
    off_m = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.12)
    assert len(mesh.vertices) > 5000 and off_m.mean() < 0.001 and np.quantile(off_m, 0.95) < 0.002
