"""Mesh files: they are read back by our reader and by handmade readers; other files are refused."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from sigmasplat.errors import RunError, SourceError
from sigmasplat.io.mesh import read_mesh, write_mesh
from sigmasplat.model.mesh import Mesh


def some_mesh(colors: bool = True) -> Mesh:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)).astype(np.float32)
    faces = rng.integers(0, 50, (80, 3)).astype(np.int32)
    return Mesh(vertices, faces, rng.integers(0, 256, (50, 3)).astype(np.float32) / 255 if colors else None)


EMPTY = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))


def test_ply_is_read_back_unchanged(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.ply", mesh)
    back = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.colors, mesh.colors, atol=1e-6)
    write_mesh(tmp_path / "b.PLY", back)
    assert (tmp_path / "b.PLY").read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "b.PLY"]


@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
def test_a_mesh_without_faces_or_colours_can_be_written(tmp_path: Path, ending: str) -> None:
    for mesh in (EMPTY, some_mesh(colors=False)):
        write_mesh(tmp_path / f"a.{ending}", mesh)
        if ending == "ply":
            assert len(read_mesh(tmp_path / "a.ply").faces) == len(mesh.faces)


def test_ply_has_the_layout_of_its_header(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.ply", mesh)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 50"]
    assert lines[-2:] == ["element face 80", "property list uchar int vertex_indices"]
    assert [line.split()[-1] for line in lines if line.startswith("property ") and "list" not in line] == [
        "x", "y", "z", "red", "green", "blue",
    ]  # fmt: skip
    assert len(body) == 50 * 15 + 80 * 13
    assert struct.unpack("<3f3B", body[15:30]) == (*mesh.vertices[1], *(mesh.colors[1] * 255).round().astype(int))
    assert struct.unpack("<B3i", body[-13:]) == (3, *mesh.faces[-1])


def test_obj_has_the_same_values(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.obj", mesh)
    words = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines()]
    vertices = np.array([w[1:] for w in words if w[0] == "v"], float)
    faces = np.array([w[1:] for w in words if w[0] == "f"], int)
    np.testing.assert_allclose(vertices, np.hstack([mesh.vertices, mesh.colors]), atol=1e-4)
    np.testing.assert_array_equal(faces, mesh.faces + 1)


def test_glb_has_the_same_values_and_stands_upright(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    scene = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    assert struct.unpack("<I4s", data[20 + size : 28 + size]) == (len(binary), b"BIN\0")
    assert scene["buffers"] == [{"byteLength": len(binary)}]
    primitive = scene["meshes"][0]["primitives"][0]
    arrays = []
    for number, kind in ((primitive["attributes"]["POSITION"], "<f4"), (primitive["indices"], "<u4")):
        view = scene["bufferViews"][scene["accessors"][number]["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays.append(np.frombuffer(part, kind).reshape(-1, 3))
    np.testing.assert_array_equal(arrays[0], mesh.vertices)
    np.testing.assert_array_equal(arrays[1], mesh.faces)
    assert scene["accessors"][0]["max"] == pytest.approx(mesh.vertices.max(0).tolist())
    x, y, z, w = scene["nodes"][0]["rotation"]
    assert (x, y, z, w) == (1, 0, 0, 0), "a rotation by 180° about x: down becomes −y, forward −z"


def by_hand(
    path: Path, order: str, rows: bytes, faces: bytes, extra: str = "", count: int = 3, number: int = 1
) -> Path:
    """Write a PLY as other programs do: doubles, float colours, flags after the list, comments."""
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment made by hand\nelement vertex {count}\nproperty double x\n"
        f"property double y\nproperty double z\n{extra}element face {number}\nproperty list uint8 uint32 vertex_index\n"
        "property uchar flags\nend_header\n"
    )
    path.write_bytes(header.encode() + rows + faces)
    return path


def test_meshes_of_other_programs_are_read(tmp_path: Path) -> None:
    colors = "property float red\nproperty float green\nproperty float blue\n"
    rows = b"".join(struct.pack(">3d3f", i, 2.5, -i, 0.1, 0.2, 1.0) for i in range(3))
    mesh = read_mesh(by_hand(tmp_path / "a.ply", "big", rows, struct.pack(">B3IB", 3, 2, 1, 0, 7), colors))
    assert mesh.vertices.tolist() == [[0, 2.5, 0], [1, 2.5, -1], [2, 2.5, -2]] and mesh.faces.tolist() == [[2, 1, 0]]
    np.testing.assert_allclose(mesh.colors, np.tile([0.1, 0.2, 1.0], (3, 1)), atol=1e-6)
    rows = b"".join(struct.pack("<3d", i, 0, 0) for i in range(3))
    assert read_mesh(by_hand(tmp_path / "b.ply", "little", rows, struct.pack("<B3IB", 3, 0, 1, 2, 0))).colors is None


def test_polygons_are_divided_into_triangles(tmp_path: Path) -> None:
    rows = struct.pack("<15d", *range(15))
    quads = struct.pack("<B4IB", 4, 0, 1, 2, 3, 0) + struct.pack("<B4IB", 4, 4, 3, 2, 1, 0)
    mesh = read_mesh(by_hand(tmp_path / "quads.ply", "little", rows, quads, count=5, number=2))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 3, 2], [4, 2, 1]]
    fives = struct.pack("<B5IB", 5, 0, 1, 2, 3, 4, 0)
    mesh = read_mesh(by_hand(tmp_path / "fives.ply", "little", rows, fives, count=5, number=1))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


def refused(path: Path) -> str:
    with pytest.raises(SourceError) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def test_other_files_are_refused(tmp_path: Path) -> None:
    write_mesh(tmp_path / "whole.ply", some_mesh())
    whole = (tmp_path / "whole.ply").read_bytes()
    path = tmp_path / "damaged.ply"
    assert "cannot read mesh" in refused(tmp_path / "nothing.ply")
    for content, words in (
        (b"solid stl", "is not a PLY file"),
        (whole[:60], "no 'end_header'"),
        (whole[:-1], "says 80 of element face, found 79"),
        (whole[:400], "element vertex"),
        (whole.replace(b"binary_little_endian", b"ascii"), "is not binary"),
        (whole.replace(b"property float y", b"property text y"), "cannot read the PLY's properties"),
        (whole.replace(b"property float y", b"property float q"), "needs vertices with x, y, z"),
        (whole[: whole.index(b"element face")] + b"end_header\n" + bytes(50 * 15), "is it a point cloud"),
        (whole[:-13] + struct.pack("<B3i", 3, 0, 1, 50), "vertices that do not exist"),
        (whole[:-13] + struct.pack("<B3i", 4, 0, 1, 2), "not all faces have the same number of vertices"),
    ):
        path.write_bytes(content)
        assert words in refused(path), words
    rows = struct.pack("<12d", *range(12))
    mixed = struct.pack("<B4IB", 4, 0, 1, 2, 3, 0) + struct.pack("<B3IB", 3, 0, 1, 2, 0) * 2
    for faces in (mixed, struct.pack("<B2IB", 2, 0, 1, 0) * 3):
        message = refused(by_hand(path, "little", rows, faces, count=4, number=3))
        assert "not all faces have the same number of vertices" in message
    nan = struct.pack("<9d", *range(8), float("nan"))
    assert "nan or inf" in refused(by_hand(path, "little", nan, struct.pack("<B3IB", 3, 0, 1, 2, 0)))


def test_unknown_endings_and_unwritable_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"a\.stl; give a name that ends in \.ply, \.obj, \.glb"):
        write_mesh(tmp_path / "a.stl", some_mesh())
    with pytest.raises(RunError, match="choose a writable place"):
        write_mesh(tmp_path / "missing" / "a.ply", some_mesh())
