"""Map files that cannot be read: an error of one line that says what is wrong and what to do."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image

from sigmasplat import cli
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SourceError
from sigmasplat.plugins.outputs.splats import gltf, sog, splat, spz
from sigmasplat.plugins.outputs.splats.read_any import read_any
from sigmasplat.run_folder import splat_ply as ply

WRITERS = {
    ".ply": ply.write_field, ".splat": splat.write_field,
    ".spz": spz.write_field, ".sog": sog.write_field, ".glb": gltf.write_field,
}  # fmt: skip


def map_bytes(folder: Path, ending: str, n: int = 5) -> bytes:
    field = GaussianField(torch.randn(n, 17, generator=torch.Generator().manual_seed(0)))
    field.get_or_create("harmonics").params[:] = 0.25
    WRITERS[ending](folder / f"good{ending}", field)
    return (folder / f"good{ending}").read_bytes()


def refusal(path: Path) -> str:
    with pytest.raises(SourceError) as caught:
        read_any(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def archive(meta: str = "{}", **members: bytes) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as file:
        file.writestr("meta.json", meta)
        for name, data in members.items():
            file.writestr(f"{name}.webp", data)
    return memory.getvalue()


def sog_meta(count: int) -> str:
    means = {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["a.webp", "a.webp"]}
    return json.dumps({"version": 2, "count": count, "means": means})


def picture(width: int, height: int) -> bytes:
    memory = io.BytesIO()
    Image.new("RGBA", (width, height)).save(memory, "WEBP", lossless=True)
    return memory.getvalue()


def glb(document: object, data: bytes = b"") -> bytes:
    words = json.dumps(document).encode()
    words += b" " * (-len(words) % 4)
    body = struct.pack("<I4s", len(words), b"JSON") + words + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def splat_glb(accessor: dict[str, object], view: dict[str, object], **more: object) -> bytes:
    primitive = {"attributes": {"POSITION": 0}, "extensions": {"KHR_gaussian_splatting": {}}}
    document = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [primitive]}], "buffers": [{}]}
    position = {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"} | accessor
    return glb(
        document | {"accessors": [position], "bufferViews": [{"buffer": 0, "byteLength": 12} | view]} | more, bytes(12)
    )


def spz_header(version: int = 3, count: int = 1, degree: int = 0, magic: bytes = b"NGSP") -> bytes:
    return struct.pack("<4sIIBBBB", magic, version, count, degree, 12, 0, 0)


PLY = b"ply\nformat binary_little_endian 1.0\n"
MISTAKES: dict[str, tuple[bytes, str]] = {
    "an empty file": (b"", "it is empty"),
    "a point cloud": (PLY + b"element vertex 1\nproperty float x\nend_header\n" + bytes(4), "no column y"),
    "a PLY of text": (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "not binary"),
    "a mesh whose faces come first": (PLY + b"element face 1\nend_header\n", "first element is not 'vertex'"),
    "a PLY without columns": (PLY + b"element vertex 3\nend_header\n", "'vertex' has none"),
    "a count of a thousand digits": (PLY + b"element vertex " + b"9" * 5000 + b"\nend_header\n", "not 'vertex'"),
    "a count larger than any disk": (
        PLY + b"element vertex 999999999999999\nproperty float x\nend_header\n", "is truncated"
    ),
    "SuperSplat's compressed PLY": (PLY + b"element chunk 1\nend_header\n", "which is not read; save it as SOG or as"),
    "SOG of version 1": (archive(), "not a SOG file of version 2"),
    "another zip": (archive().replace(b"meta.json", b"data.json"), "it has no meta.json"),
    "SOG whose meta data is not JSON": (archive("{"), "meta.json is not JSON"),
    "SOG that says more splats than it can hold": (archive(sog_meta(1 << 40)), "count in meta.json must be"),
    "SOG without an image": (archive(sog_meta(5)), "it has no a.webp"),
    "SOG whose image is no image": (archive(sog_meta(5), a=b"hello"), "a.webp is not a WebP image"),
    "SOG whose image is too small": (archive(sog_meta(50), a=picture(4, 4)), "a.webp has 4 × 4 pixels"),
    "SOG whose image is too large": (archive(sog_meta(5), a=picture(2000, 2000)), "a.webp has 2000 × 2000 pixels"),
    "SPZ of version 4": (b"NGSP\4" + bytes(40), "is SPZ of version 4, which is not read; save it as version 3"),
    "SPZ of a future version": (gzip.compress(spz_header(9)), "SPZ version 9"),
    "SPZ with harmonics of degree 4": (gzip.compress(spz_header(degree=4)), "harmonics of degree 4"),
    "SPZ that is shorter than its header says": (gzip.compress(spz_header(count=1000)), "says 1000 splats"),
    "SPZ whose header says terabytes": (gzip.compress(spz_header(count=0xFFFFFFFF)), "says 4294967295 splats"),
    "gzip of other data": (gzip.compress(b"a diary, and a long one"), "not an SPZ file"),
    "a GLB of nothing": (b"glTF" + bytes(60), "is a GLB of version 0"),
    "a GLB mesh": (glb({"asset": {"version": "2.0"}, "meshes": [{"primitives": [{}]}]}), "has no splats"),
    "a GLB of glTF 1": (glb({"asset": {"version": "1.0"}}), "is glTF 1.0"),
    "a GLB whose chunk is too long": (glb({})[:-1], "is truncated"),
    "a GLB whose JSON is a list": (glb([]), "is not glTF 2.0"),
    "splats beyond their buffer": (splat_glb({"count": 1 << 50}, {}), "POSITION is larger than its part of the buffer"),
    "splats beyond the file": (splat_glb({}, {"byteLength": 1 << 40, "byteOffset": 999}), "POSITION ends at byte"),
    "splats with a sparse accessor": (splat_glb({"sparse": {}}, {}), "POSITION is not a plain accessor"),
    "splats in a compressed buffer": (splat_glb({}, {"extensions": {"EXT_meshopt_compression": {}}}), "is compressed"),
    "splats of a moved node": (splat_glb({}, {}, nodes=[{"mesh": 0, "scale": [2, 2, 2]}]), "moved by the scale"),
    "splats without rotations": (splat_glb({}, {}), "it has no attribute KHR_gaussian_splatting:ROTATION"),
    "splats in another file": (splat_glb({}, {}, buffers=[{"uri": "../x"}]), "is in another file; save the map"),
    "a .gltf": (b'{"asset": {"version": "2.0"}}', "is JSON; give the file with the splats, of glTF the .glb"),
    "a GLB without splats": (glb({"asset": {"version": "2.0"}}), "has no splats"),
    "a Git LFS pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "a web page instead of a download": (b"\n<!DOCTYPE html><html>404</html>", "a web page"),
    "an image": (b"\x89PNG\r\n\x1a\n" + bytes(56), "an image"),
    "random bytes": (bytes(range(256)), "not a .splat file, or is damaged: splat 0"),
    "text of an odd length": (b"hello", "5 bytes are not a multiple of 32"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_other_files_are_refused_with_one_line(tmp_path: Path, mistake: str) -> None:
    content, says = MISTAKES[mistake]
    (tmp_path / "given").write_bytes(content)
    assert says in refusal(tmp_path / "given")


def test_missing_files_and_folders(tmp_path: Path) -> None:
    assert "cannot read map" in refusal(tmp_path / "no.spz")
    assert "is a folder, not a map" in refusal(tmp_path)


@pytest.mark.parametrize("ending", WRITERS)
def test_truncated_files_are_refused(tmp_path: Path, ending: str) -> None:
    """At every length, except between two splats of a .splat file, whose header has no count."""
    good = map_bytes(tmp_path, ending)
    assert len(read_any(tmp_path / f"good{ending}")) == 5
    for length in range(0, len(good), 7):
        if ending == ".splat" and length and length % 32 == 0:
            continue
        (tmp_path / "cut").write_bytes(good[:length])
        refusal(tmp_path / "cut")


@pytest.mark.parametrize("ending", WRITERS)
def test_flipped_bytes_are_refused_or_give_finite_splats(
    tmp_path: Path, ending: str, recwarn: pytest.WarningsRecorder
) -> None:
    good = map_bytes(tmp_path, ending)
    refused_count = 0
    for place in range(0, len(good), max(1, len(good) // 150)):
        (tmp_path / "flipped").write_bytes(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :])
        try:
            field = read_any(tmp_path / "flipped")
        except SourceError:
            refused_count += 1
        else:
            assert torch.isfinite(field.params).all() and (field.quats.norm(dim=1) > 0).all()
    assert refused_count > (120 if ending == ".spz" else 10) and not recwarn.list


@pytest.fixture
def sigmasplat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run `sigmasplat` in a folder with map.ply, and map.spz without σ; return its error line."""
    monkeypatch.chdir(tmp_path)
    for name in ("map.ply", "map.spz"):
        Path(name).write_bytes(map_bytes(tmp_path, Path(name).suffix))
    for path in tmp_path.glob("good*"):
        path.unlink()

    def refused(*arguments: str) -> str:
        before = sorted(tmp_path.iterdir())
        with pytest.raises(SystemExit) as left:
            cli.main(arguments)
        said = capsys.readouterr()
        assert (
            left.value.code == 2
            and said.err.startswith("sigmasplat: ")
            and said.err.count("\n") == 1
            and said.out in ("", "writing 5 splats …\n")
        )
        assert sorted(tmp_path.iterdir()) == before
        return said.err

    return refused


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("no.ply --out x.spz", "cannot read map no.ply"),
        ("no --out x.spz", "no run folder no"),
        (". --out x.spz", "not a run folder"),
        ("map.ply --out x.obj", "unknown ending of x.obj; end it in .ply,"),
        ("map.ply --out x", "or give --format"),
        ("map.ply --out x.spz --format spt", "no format 'spt'; there are ply,"),
        ("map.ply --out x.txt", "map.ply is a file, which can be exported only as another map"),
        ("map.ply --out map.spz", "map.spz exists"),
        ("map.ply --out x.spz --plain", "--plain cannot be used with format spz, only with ply"),
        ("map.ply --format trajectory --sigma-below 1", "--sigma-below cannot be used with format trajectory"),
        ("map.ply --out x.spz --sigma-below -1", "--sigma-below must be at least 0, found -1"),
        ("map.ply --out x.spz --opacity-above nan", "--opacity-above must be finite and at least 0, found nan"),
        ("map.spz --out x.ply --sigma-below 1", "map.spz has no learned σ"),
        ("map.ply --out x.spz --std-below-m -1", "--std-below-m must be at least 0, found -1"),
        ("map.ply --out x.spz --std-below-m 1", "map.ply has no calibrated uncertainty"),
        ("map.ply --out x.spz --sigma-below 0", "no splat of map.ply is left (median σ and opacity are "),
        ("map.ply --out no/x.spz", "cannot write no: "),
        ("map.ply --out x.glb --axes z-up", "--axes z-up cannot be used with this format, only y-up, camera"),
        ("map.ply --out x.sog --max-splats 3", "map.ply is not a run, so --max-splats cannot be used"),
        ("map.ply --out x.sog --max-splats 0", "--max-splats must be at least 1, found 0"),
        ("map.ply --out x.txt --axes y-up", "--axes cannot be used with format trajectory"),
    ],
)  # fmt: skip
def test_export_refuses_with_one_line(sigmasplat: Callable[..., str], arguments: str, says: str) -> None:
    assert says in sigmasplat("export", *arguments.split())
