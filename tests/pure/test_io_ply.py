"""The map file: round trip, the columns that other programs need, and maps of other programs."""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from sigmasplat.data.field import ATTRIBUTES, GaussianField, Rows
from sigmasplat.errors import RunError, SourceError
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.splat_ply import SH_C0, read_field, write_field
from sigmasplat.uncertainty.map_uncertainty import SplatStd


def random_field(n: int = 50, seed: int = 0) -> GaussianField:
    generator = torch.Generator().manual_seed(seed)
    return GaussianField(torch.randn(n, 17, generator=generator))


def header_of(data: bytes) -> list[str]:
    return data[: data.index(b"end_header\n")].decode("ascii").splitlines()


def test_a_map_is_read_back_unchanged(tmp_path: Path) -> None:
    field = random_field()
    write_field(tmp_path / "map.ply", field)
    back = read_field(tmp_path / "map.ply")
    torch.testing.assert_close(back.params, field.params, rtol=0, atol=1e-6)
    others = [i for i in range(17) if not 11 <= i < 14]
    assert torch.equal(back.params[:, others], field.params[:, others]), "only colours are converted"
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"], "no temporary file remains"


def test_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    """The bytes of one splat: names, order, and the values that a viewer expects."""
    field = GaussianField.from_values(
        torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[1.0, 0.5, 0.25]]),
        quats=torch.tensor([[0.5, 0.5, -0.5, 0.5]]), opacities=0.75, log_variances=-4.0,
    )  # fmt: skip
    write_field(tmp_path / "map.ply", field)
    data = (tmp_path / "map.ply").read_bytes()
    header = header_of(data)
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    names = [line.split()[2] for line in header if line.startswith("property float")]
    assert " ".join(names) == (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 "
        "log_variance_0 log_variance_1 log_variance_2"
    )
    values = dict(zip(names, np.frombuffer(data[data.index(b"end_header\n") + 11 :], "<f4"), strict=True))
    assert [values[c] for c in "xyz"] == [1.0, 2.0, 3.0]
    assert values["f_dc_0"] == pytest.approx(0.5 * 2 * np.sqrt(np.pi)) and values["f_dc_1"] == 0.0
    assert values["opacity"] == pytest.approx(np.log(3.0)) and values["scale_2"] == pytest.approx(np.log(0.3))
    assert [values[f"rot_{i}"] for i in range(4)] == [0.5, 0.5, -0.5, 0.5]


@pytest.mark.parametrize("harmonics", [False, True])
def test_columns_are_found_by_a_reader_that_uses_names(tmp_path: Path, harmonics: bool) -> None:
    """Read as viewers do: sum up the offsets of the properties, and find each value by its name."""
    field = random_field(4)
    if harmonics:
        field.get_or_create("harmonics").params[:] = torch.arange(180.0).reshape(4, 45)
    write_field(tmp_path / "map.ply", field)
    header, _, data = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float ")]
    assert len(data) == 4 * 4 * len(names), "only float32, and nothing after them"
    for i in range(4):
        row = dict(zip(names, struct.unpack_from(f"<{len(names)}f", data, 4 * len(names) * i), strict=True))
        params = field.params[i].tolist()
        assert [row[name] for name in ("x", "y", "z")] == params[0:3]
        assert [row[f"rot_{k}"] for k in range(4)] == params[3:7] and [row[f"scale_{k}"] for k in range(3)] == params[
            7:10
        ]
        assert row["opacity"] == params[10]
        assert [0.5 + 0.28209479 * row[f"f_dc_{k}"] for k in range(3)] == pytest.approx(params[11:14], abs=1e-6)
        assert [row["nx"], row["ny"], row["nz"]] == [0.0] * 3
        if harmonics:
            assert [row[f"f_rest_{k}"] for k in (0, 1, 15, 30, 44)] == [45.0 * i + k for k in (0, 3, 1, 2, 44)]


@pytest.mark.parametrize("harmonics", [False, True])
def test_plain_files_have_the_fixed_layout_of_3dgs(tmp_path: Path, harmonics: bool) -> None:
    """Read as its own viewer does: the number of splats in line 3, then records of 62 floats, without the names."""
    field = random_field(3)
    if harmonics:
        field.get_or_create("harmonics").params[:] = torch.arange(135.0).reshape(3, 45)
    write_field(tmp_path / "map.ply", field, plain=True)
    lines, _, data = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert lines.splitlines()[2] == b"element vertex 3" and len(data) == 3 * 62 * 4
    for i, params in enumerate(field.params.tolist()):
        record = struct.unpack_from("<62f", data, 62 * 4 * i)
        assert list(record[0:3]) == params[0:3] and record[3:6] == (0.0, 0.0, 0.0)
        assert [0.5 + 0.28209479 * k for k in record[6:9]] == pytest.approx(params[11:14], abs=1e-6)
        red = [45.0 * i + 3 * k for k in range(15)] if harmonics else [0.0] * 15
        assert list(record[9:24]) == red
        assert record[54] == params[10] and list(record[55:58]) == params[7:10] and list(record[58:62]) == params[3:7]
    back = read_field(tmp_path / "map.ply")
    assert (back.params[:, 14:] == -7.0).all() and torch.allclose(back.params[:, :14], field.params[:, :14], atol=1e-6)


def test_harmonics_are_written_as_in_3dgs_and_read_back(tmp_path: Path) -> None:
    """f_rest follows f_dc: fifteen of red, then green, then blue; other columns are as without harmonics."""
    field = random_field(5)
    write_field(tmp_path / "plain.ply", field)
    k = torch.randn(5, 45, generator=torch.Generator().manual_seed(1))
    field.attributes["harmonics"] = Rows(k)
    write_field(tmp_path / "shiny.ply", field)
    plain, shiny = ((tmp_path / name).read_bytes() for name in ("plain.ply", "shiny.ply"))
    names = [line.split()[2] for line in header_of(shiny) if line.startswith("property float")]
    rest = [f"f_rest_{i}" for i in range(45)]
    assert names[6:10] == ["f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"] and names[9:54] == rest
    tables = []
    for data in (plain, shiny):
        columns = [line.split()[2] for line in header_of(data) if line.startswith("property float")]
        tables.append(np.frombuffer(data[data.index(b"end_header\n") + 11 :], [(n, "<f4") for n in columns]))
    assert [n for n in names if n not in rest] == list(tables[0].dtype.names or ())
    assert all((tables[0][n] == tables[1][n]).all() for n in tables[0].dtype.names or ())
    for channel, harmonic in ((0, 0), (1, 0), (2, 14), (1, 7)):
        assert (tables[1][f"f_rest_{15 * channel + harmonic}"] == k[:, 3 * harmonic + channel].numpy()).all()
    back = read_field(tmp_path / "shiny.ply")
    assert torch.equal(back.attributes["harmonics"].params, k) and not read_field(tmp_path / "plain.ply").attributes


def test_harmonics_of_lower_degrees_are_read(tmp_path: Path) -> None:
    for given, each in [(9, 3), (24, 8), (45, 15)]:
        other_programs_ply(tmp_path / "other.ply", "<", rest=given)
        k = read_field(tmp_path / "other.ply").attributes["harmonics"].params
        assert k.shape == (3, 45) and torch.count_nonzero(k[:, 3 * each :]) == 0
        first = 10  # column of f_rest_0, whose value in row 0 is its number
        assert k[0, :3].tolist() == [first, first + each, first + 2 * each] and k[0, 3 * each - 1] == first + given - 1


def test_a_wrong_number_of_harmonics_is_refused(tmp_path: Path) -> None:
    for given in [1, 12, 46]:
        other_programs_ply(tmp_path / "other.ply", "<", rest=given)
        with pytest.raises(SourceError, match=f"has {given} columns f_rest, expected 0 or f_rest_0 to 8, 23 or 44"):
            read_field(tmp_path / "other.ply")


def test_harmonics_with_nan_are_refused(tmp_path: Path) -> None:
    field = random_field()
    field.get_or_create("harmonics").params[4, 44] = float("nan")
    write_field(tmp_path / "map.ply", field)
    with pytest.raises(SourceError, match=r"splat 4 has nan or inf \(1 of 50 splats do\)"):
        read_field(tmp_path / "map.ply")


def other_programs_ply(path: Path, order: str, drop: str = "", rows: int = 3, rest: int = 45) -> None:
    """Write a map as the 3DGS reference does: with f_rest and another order of columns, after comments."""
    names = ["rot_0", "rot_1", "rot_2", "rot_3", "x", "y", "z", *(f"f_dc_{i}" for i in range(3)),
             *(f"f_rest_{i}" for i in range(rest)), "opacity", "scale_0", "scale_1", "scale_2"]  # fmt: skip
    names = [name for name in names if name != drop]
    table = np.zeros(rows, [(name, f"{order}f8" if name == "x" else f"{order}f4") for name in names])
    for i, name in enumerate(names):
        table[name] = i + np.arange(rows) / 8
    properties = "".join(f"property {'double' if name == 'x' else 'float'} {name}\n" for name in names)
    kind = {"<": "little", ">": "big"}[order]
    header = f"ply\nformat binary_{kind}_endian 1.0\ncomment of another\nelement vertex {rows}\n{properties}"
    path.write_bytes((header + "element face 0\nproperty list uchar int v\nend_header\n").encode() + table.tobytes())


@pytest.mark.parametrize("order", ["<", ">"])
def test_maps_of_other_programs_are_read_by_column_names(tmp_path: Path, order: str) -> None:
    other_programs_ply(tmp_path / "other.ply", order)
    field = read_field(tmp_path / "other.ply")
    assert field.means[1].tolist() == [4.125, 5.125, 6.125]
    assert field.quats[0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert field.colors[0].tolist() == pytest.approx([0.5 + SH_C0 * i for i in (7, 8, 9)])
    assert field.params[2, 10] == 55.25 and (field.params[:, 14:] == -7.0).all()


def test_an_empty_map_can_be_written_and_read(tmp_path: Path) -> None:
    write_field(tmp_path / "map.ply", GaussianField.empty())
    assert len(read_field(tmp_path / "map.ply")) == 0


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    other_programs_ply(tmp_path / "other.ply", "<", drop="scale_1")
    with pytest.raises(SourceError, match=r"other\.ply is not a map of splats: no column scale_1"):
        read_field(tmp_path / "other.ply")


def test_nan_and_inf_are_refused(tmp_path: Path) -> None:
    for value in [float("nan"), float("inf")]:
        field = random_field()
        field.params[7, 5] = value
        write_field(tmp_path / "map.ply", field)
        with pytest.raises(SourceError, match=r"splat 7 has nan or inf \(1 of 50 splats do\)"):
            read_field(tmp_path / "map.ply")


def test_a_zero_quaternion_is_refused(tmp_path: Path) -> None:
    field = random_field()
    field.params[3, 3:7] = 0.0
    write_field(tmp_path / "map.ply", field)
    with pytest.raises(SourceError, match="splat 3 has a zero quaternion"):
        read_field(tmp_path / "map.ply")


def test_truncation_is_refused_at_every_length(tmp_path: Path) -> None:
    """Truncate a valid file at many places: each time SourceError is raised."""
    write_field(tmp_path / "map.ply", random_field(3))
    data = (tmp_path / "map.ply").read_bytes()
    for length in range(0, len(data), 13):
        (tmp_path / "cut.ply").write_bytes(data[:length])
        with pytest.raises(SourceError, match=r"cut\.ply"):
            read_field(tmp_path / "cut.ply")


BINARY = b"ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "not a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", r"not binary \(format ascii"),
        (b"ply\nelement vertex 1\nend_header\n", "not binary"),
        (BINARY + b"element face 2\nend_header\n", "first element is not 'vertex'"),
        (BINARY + b"element vertex -2\nend_header\n", "first element is not 'vertex'"),
        (BINARY + b"element vertex 1\nproperty list uchar int a\nend_header\n", "list uchar int a"),
        (BINARY + b"element vertex 1\nproperty float x\nproperty float x\nend_header\n", "twice"),
    ],
)  # fmt: skip
def test_other_files_are_refused_with_one_line(tmp_path: Path, content: bytes, complaint: str) -> None:
    (tmp_path / "x.ply").write_bytes(content)
    with pytest.raises(SourceError, match=complaint) as caught:
        read_field(tmp_path / "x.ply")
    assert "\n" not in str(caught.value)


def test_a_missing_map_and_an_unwritable_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"cannot read map .*No such file"):
        read_field(tmp_path / "no.ply")
    with pytest.raises(RunError, match="cannot write"):
        write_field(tmp_path / "no" / "map.ply", random_field())


@pytest.mark.parametrize("plain", [False, True])
def test_a_map_that_is_converted_in_parts_has_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plain: bool
) -> None:
    field = random_field(23)
    field.get_or_create("harmonics").params[:] = torch.randn(23, ATTRIBUTES["harmonics"], generator=torch.Generator())
    std = SplatStd(*torch.rand(2, 23, generator=torch.Generator()))
    write_field(tmp_path / "whole.ply", field, plain=plain, std=std)
    monkeypatch.setattr(ply, "AT_ONCE", 5)
    write_field(tmp_path / "parts.ply", field, plain=plain, std=std)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


MANY_SUBMAPS = """
import sys, torch
from pathlib import Path
from sigmasplat.run_folder.splat_ply import write_field
from sigmasplat.data.field import GaussianField
peak_mib = lambda: int(next(s for s in open("/proc/self/status") if s.startswith("VmHWM")).split()[1]) / 1024
one = GaussianField(torch.rand(100_000, 17))
before = peak_mib()
field = GaussianField.side_by_side(one.moved(torch.eye(4)) for _ in range(30))
write_field(Path(sys.argv[1]), field)
print((peak_mib() - before) / (field.params.nbytes / 2**20))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_joining_and_writing_the_maps_of_many_submaps_takes_little_more_than_twice_their_memory(tmp_path: Path) -> None:
    """A run of half an hour has tens of millions of splats when Ctrl-C ends it."""
    done = subprocess.run(
        [sys.executable, "-c", MANY_SUBMAPS, str(tmp_path / "map.ply")], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < 3.5
