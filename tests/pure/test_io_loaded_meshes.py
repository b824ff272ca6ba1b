"""Files of meshes, loaded by trimesh."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmasplat.data.mesh import Mesh
from sigmasplat.plugins.outputs.mesh_files import linear, read_mesh, write_mesh

trimesh = pytest.importorskip("trimesh", reason="the [dev] extra is not installed")


def ball() -> Mesh:
    """Return a coloured ball of radius 0.5 m with centre (1, 2, 3)."""
    made = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    colors = np.random.default_rng(0).integers(0, 256, made.vertices.shape) / np.float32(255.0)
    return Mesh(
        np.add(made.vertices, [1, 2, 3]).astype(np.float32), made.faces.astype(np.int32), colors.astype(np.float32)
    )


def test_normals_of_a_ball_point_outwards_and_unused_vertices_have_none() -> None:
    mesh = ball()
    outwards = (mesh.vertices - np.array([1, 2, 3])) / 0.5
    assert (mesh.normals() * outwards).sum(1).min() > 0.995
    theirs = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    triangle = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], np.float32), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(triangle.normals(), [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 0]])
    assert (mesh.normals() * theirs.vertex_normals).sum(1).min() > 0.999


def test_vertices_are_loaded_with_their_standard_deviation(tmp_path: Path) -> None:
    mesh = ball()
    known = replace(mesh, depth_std_m=np.linspace(0.001, 0.1, len(mesh.vertices)).astype(np.float32))
    for name in ("a.ply", "a.glb"):
        write_mesh(tmp_path / name, known)
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    rows = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(rows["depth_std_m"].ravel(), known.depth_std_m)
    normals = np.stack([rows[name].ravel() for name in ("nx", "ny", "nz")], 1)
    np.testing.assert_allclose(normals, mesh.normals(), atol=1e-6)
    np.testing.assert_array_equal(loaded.vertices.astype(np.float32), mesh.vertices)
    loaded = trimesh.load(tmp_path / "a.glb", process=False, force="mesh")
    np.testing.assert_array_equal(loaded.vertex_attributes["_DEPTH_STD_M"].ravel(), known.depth_std_m)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").vertices, mesh.vertices)


@pytest.mark.parametrize("ending", ["ply", "glb", "stl"])
def test_meshes_are_loaded_by_a_standard_loader(tmp_path: Path, ending: str) -> None:
    mesh = ball()
    write_mesh(tmp_path / f"a.{ending}", mesh)
    loaded = trimesh.load_scene(tmp_path / f"a.{ending}", process=False, maintain_order=True)
    (loaded,) = loaded.geometry.values()
    np.testing.assert_allclose(loaded.triangles, mesh.corners, atol=1e-5)
    if ending == "stl":
        loaded.merge_vertices()  # every triangle has its own
    else:
        np.testing.assert_array_equal(loaded.faces, mesh.faces)
        np.testing.assert_allclose(loaded.vertex_normals, mesh.normals(), atol=2e-4)
    if ending == "glb":  # linear, 16 bits, beside the material
        shown = loaded.visual.vertex_attributes["color"][:, :3] / 65535.0
        np.testing.assert_allclose(shown, linear(mesh.colors), atol=1e-4)
    elif ending != "stl":
        np.testing.assert_allclose(loaded.visual.vertex_colors[:, :3], np.rint(mesh.colors * 255), atol=1)
    assert loaded.is_watertight and loaded.volume == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.07)
