"""Map files that cannot be read: an error of one line that says what is wrong and what to do."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from sigmasplat import cli
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import SourceError
from sigmasplat.run_folder import splat_ply as ply


def map_bytes(folder: Path, n: int = 5) -> bytes:
    field = GaussianField(torch.randn(n, 17, generator=torch.Generator().manual_seed(0)))
    field.get_or_create("harmonics").params[:] = 0.25
    ply.write_field(folder / "good.ply", field)
    return (folder / "good.ply").read_bytes()


def refusal(path: Path) -> str:
    with pytest.raises(SourceError) as caught:
        ply.read_field(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


PLY = b"ply\nformat binary_little_endian 1.0\n"
MISTAKES: dict[str, tuple[bytes, str]] = {
    "an empty file": (b"", "not a PLY file"),
    "a point cloud": (PLY + b"element vertex 1\nproperty float x\nend_header\n" + bytes(4), "no column y"),
    "a PLY of text": (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "not binary"),
    "a mesh whose faces come first": (PLY + b"element face 1\nend_header\n", "first element is not 'vertex'"),
    "a PLY without columns": (PLY + b"element vertex 3\nend_header\n", "'vertex' has none"),
    "a count of a thousand digits": (PLY + b"element vertex " + b"9" * 5000 + b"\nend_header\n", "not 'vertex'"),
    "a count larger than any disk": (
        PLY + b"element vertex 999999999999999\nproperty float x\nend_header\n", "is truncated"
    ),
    "SuperSplat's compressed PLY": (PLY + b"element chunk 1\nend_header\n", "first element is not 'vertex'"),
    "a Git LFS pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "not a PLY file"),
    "a web page instead of a download": (b"\n<!DOCTYPE html><html>404</html>", "not a PLY file"),
    "an image": (b"\x89PNG\r\n\x1a\n" + bytes(56), "not a PLY file"),
    "random bytes": (bytes(range(256)), "not a PLY file"),
    "text of an odd length": (b"hello", "give a binary PLY"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_other_files_are_refused_with_one_line(tmp_path: Path, mistake: str) -> None:
    content, says = MISTAKES[mistake]
    (tmp_path / "given").write_bytes(content)
    assert says in refusal(tmp_path / "given")


def test_missing_files(tmp_path: Path) -> None:
    assert "cannot read map" in refusal(tmp_path / "no.ply")


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    good = map_bytes(tmp_path)
    assert len(ply.read_field(tmp_path / "good.ply")) == 5
    for length in range(0, len(good), 7):
        (tmp_path / "cut").write_bytes(good[:length])
        refusal(tmp_path / "cut")


def test_flipped_bytes_are_refused_or_give_finite_splats(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    good = map_bytes(tmp_path)
    refused_count = 0
    for place in range(0, len(good), max(1, len(good) // 150)):
        (tmp_path / "flipped").write_bytes(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :])
        try:
            field = ply.read_field(tmp_path / "flipped")
        except SourceError:
            refused_count += 1
        else:
            assert torch.isfinite(field.params).all() and (field.quats.norm(dim=1) > 0).all()
    assert refused_count > 10 and not recwarn.list


@pytest.fixture
def sigmasplat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run `sigmasplat` in a folder with map.ply, and plain.ply without σ; return its error line."""
    monkeypatch.chdir(tmp_path)
    Path("map.ply").write_bytes(map_bytes(tmp_path))
    ply.write_field(Path("plain.ply"), ply.read_field(Path("map.ply")), plain=True)
    Path("good.ply").unlink()

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
        ("map.ply --out x", "or give --format; --plugin FILE.py adds others"),
        ("map.ply --out x.spz --format spt", "no format 'spt'; there are ply,"),
        ("map.ply --out x.spz --format spt", ", plan, html; --plugin FILE.py adds others"),
        ("map.ply --out x.txt", "map.ply is a file, which can be exported only as another map"),
        ("map.ply --out plain.ply", "plain.ply exists"),
        ("map.ply --out x.spz --plain", "--plain cannot be used with format spz, only with ply"),
        ("map.ply --format trajectory --std-below-m 1", "--std-below-m cannot be used with format trajectory"),
        ("map.ply --out x.spz --std-below-m nan", "--std-below-m must be finite and at least 0, found nan"),
        ("map.ply --out x.spz --std-below-m -1", "--std-below-m must be at least 0, found -1"),
        ("map.ply --out x.spz --std-below-m 1", "map.ply has no calibrated uncertainty"),
        ("map.ply --out no/x.spz", "cannot write no: "),
        ("map.ply --out x.spz --axes z-up", "--axes z-up cannot be used with this format, only y-up, camera"),
        ("map.ply --out x.txt --axes y-up", "--axes cannot be used with format trajectory"),
    ],
)  # fmt: skip
def test_export_refuses_with_one_line(sigmasplat: Callable[..., str], arguments: str, says: str) -> None:
    assert says in sigmasplat("export", *arguments.split())
