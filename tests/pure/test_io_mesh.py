"""Mesh files: they are read back by our reader and by handmade readers; other files are refused."""

import io
import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sigmasplat.data.mesh import Mesh
from sigmasplat.errors import RunError, SourceError
from sigmasplat.plugins.outputs.mesh_files import read_mesh, write_mesh
from sigmasplat.plugins.outputs.mesh_texture import TexturedMesh


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


@pytest.mark.parametrize("ending", ["ply", "glb", "stl"])
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
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and lines[2].startswith("comment ")
    assert lines[3] == "element vertex 50"
    assert lines[-2:] == ["element face 80", "property list uchar int vertex_indices"]
    assert [line.split()[-1] for line in lines if line.startswith("property ") and "list" not in line] == [
        "x", "y", "z", "nx", "ny", "nz", "red", "green", "blue",
    ]  # fmt: skip
    assert len(body) == 50 * 27 + 80 * 13
    second = struct.unpack("<6f3B", body[27:54])
    assert second[:3] + second[6:] == (*mesh.vertices[1], *(mesh.colors[1] * 255).round().astype(int))
    np.testing.assert_allclose(second[3:6], mesh.normals()[1], atol=1e-6)
    assert struct.unpack("<B3i", body[-13:]) == (3, *mesh.faces[-1])


def test_stl_has_the_same_triangles_and_no_text_header(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.stl", mesh, "axes z-up")
    data = (tmp_path / "a.stl").read_bytes()
    assert b"axes z-up" in data[:80] and not data.startswith(b"solid")
    assert struct.unpack("<I", data[80:84]) == (80,) and len(data) == 84 + 80 * 50
    rows = np.frombuffer(data[84:], np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")]))
    np.testing.assert_array_equal(rows["corners"], mesh.vertices[mesh.faces])


def parts_of_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a GLB by hand: its scene, and the arrays of its only primitive."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    scene = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    assert struct.unpack("<I4s", data[20 + size : 28 + size]) == (len(binary), b"BIN\0")
    assert scene["buffers"] == [{"byteLength": len(binary)}]
    primitive = scene["meshes"][0]["primitives"][0]
    arrays = {}
    for name, number in (*primitive["attributes"].items(), ("indices", primitive["indices"])):
        accessor = scene["accessors"][number]
        view = scene["bufferViews"][accessor["bufferView"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        type_ = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        arrays[name] = np.frombuffer(part, type_).reshape(accessor["count"], -1)
    return scene, arrays


def test_glb_has_the_same_values_and_axes(tmp_path: Path) -> None:
    mesh = some_mesh()
    write_mesh(tmp_path / "a.glb", mesh)
    scene, arrays = parts_of_glb(tmp_path / "a.glb")
    np.testing.assert_array_equal(arrays["POSITION"], mesh.vertices)
    np.testing.assert_array_equal(arrays["indices"].reshape(-1, 3), mesh.faces)
    assert scene["accessors"][0]["max"] == pytest.approx(mesh.vertices.max(0).tolist())
    assert set(scene["nodes"][0]) & {"rotation", "matrix", "scale"} == set(), "y is up in the vertices themselves"
    np.testing.assert_allclose(np.linalg.norm(arrays["NORMAL"], axis=1), 1.0, atol=1e-6)


def test_glb_shows_the_recorded_colours_in_every_viewer(tmp_path: Path) -> None:
    """glTF's default material is metal, its colours are linear, and its faces have one side."""
    gray = np.array([[0.5, 0.5, 0.5], [0.0, 1.0, 0.04], [0.2, 0.7, 0.9]], np.float32)
    write_mesh(tmp_path / "a.glb", Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), gray))
    scene, arrays = parts_of_glb(tmp_path / "a.glb")
    material = scene["materials"][scene["meshes"][0]["primitives"][0]["material"]]
    assert material["doubleSided"] and "KHR_materials_unlit" in material["extensions"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0 and "KHR_materials_unlit" in scene["extensionsUsed"]
    shown = arrays["COLOR_0"][:, :3] / 65535.0
    assert shown[0] == pytest.approx([0.2140] * 3, abs=1e-3), "0.5 in sRGB is 21 % of the light"
    np.testing.assert_allclose(
        np.where(shown > 0.0031308, 1.055 * shown ** (1 / 2.4) - 0.055, 12.92 * shown), gray, atol=1e-3
    )


GLTF_VALIDATOR = """
const validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)));
"""
THREE = """
const THREE = require("three"), fs = require("fs"), path = require("path"), { pathToFileURL } = require("url");
const loader = path.join(path.dirname(require.resolve("three")), "../examples/jsm/loaders/GLTFLoader.js");
globalThis.self = globalThis;
import(pathToFileURL(loader)).then(async ({ GLTFLoader }) => {
  const T = await import(pathToFileURL(path.join(path.dirname(require.resolve("three")), "three.module.js")));
  const data = new Uint8Array(fs.readFileSync(process.argv[1])).buffer;
  const { scene } = await new GLTFLoader().parseAsync(data, "");
  scene.updateMatrixWorld(true);
  const looks = JSON.parse(process.argv[2]).map(([from, along]) => {
    const ray = new T.Raycaster(new T.Vector3(...from), new T.Vector3(...along));
    const [hit] = ray.intersectObject(scene, true);
    const { material, geometry } = hit.object, colors = geometry.getAttribute("color");
    const at = hit.face.a, linear = new T.Color(colors.getX(at), colors.getY(at), colors.getZ(at));
    const shown = linear.convertLinearToSRGB();
    return { lit: material.type !== "MeshBasicMaterial", colored: material.vertexColors, point: hit.point.toArray(),
             shown: shown.toArray() };
  });
  console.log(JSON.stringify(looks));
});
"""


def node(package: str, program: str, *arguments: str) -> Any:
    """Run a program in node and return its JSON; skip the test where node or the package is missing."""
    found = shutil.which("node") and subprocess.run(["node", "-e", f"require('{package}')"], capture_output=True)
    if not found or found.returncode:
        pytest.skip(f"needs node and npm's {package}; set NODE_PATH to its node_modules")
    command = ["node", "-e", program, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def with_texture() -> Mesh:
    mesh, file = some_mesh(), io.BytesIO()
    Image.new("RGB", (64, 64), (200, 100, 50)).save(file, "JPEG")
    return TexturedMesh(mesh.vertices, mesh.faces, uv=np.abs(mesh.vertices[:, :2]) / 9, image=file.getvalue())


@pytest.mark.parametrize(
    "mesh",
    [some_mesh(), some_mesh(colors=False), EMPTY, with_texture()],
    ids=["coloured", "gray", "empty", "textured"],
)
def test_khronos_validator_accepts_the_glb(tmp_path: Path, mesh: Mesh) -> None:
    write_mesh(tmp_path / "a.glb", mesh)
    issues = node("gltf-validator", GLTF_VALIDATOR, str(tmp_path / "a.glb"))
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def test_three_js_shows_recorded_colours_from_both_sides(tmp_path: Path) -> None:
    """A wall one metre ahead, of one colour, is hit by a ray of three.js from the front and from behind."""
    corners = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], np.float32)
    color = np.tile(np.array([[0.2, 0.5, 0.8]], np.float32), (4, 1))
    write_mesh(tmp_path / "a.glb", Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), color))
    rays = [[[0.1, 0.3, 0], [0, 0, -1]], [[0.1, 0.3, -3], [0, 0, 1]]]
    for seen in node("three", THREE, str(tmp_path / "a.glb"), json.dumps(rays)):
        assert not seen["lit"] and seen["colored"]
        assert seen["shown"] == pytest.approx([0.2, 0.5, 0.8], abs=2e-3)
        assert seen["point"] == pytest.approx([0.1, 0.3, -1.0], abs=1e-5)


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
        (whole[: whole.index(b"element face")] + b"end_header\n" + bytes(50 * 27), "is it a point cloud"),
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
    with pytest.raises(RunError, match=r"a\.fbx; give a name that ends in \.ply, \.glb, \.stl"):
        write_mesh(tmp_path / "a.fbx", some_mesh())
    with pytest.raises(RunError, match="choose a writable place"):
        write_mesh(tmp_path / "missing" / "a.ply", some_mesh())
