"""sigmasplat export: formats by ending or name, from runs and from maps, and filtering of splats."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_readers import read_any

from command_line import exit_code
from sigmasplat.commands.export import ExportOptions
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.files.ply_elements import read_header
from sigmasplat.input.lists import read_poses
from sigmasplat.plugins.outputs.formats import PLUGIN, ExportSource, choose, listed, owners
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.registry import Output
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd


@pytest.fixture
def export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run `sigmasplat export` beside a run, walk/, of ten splats and two poses; return the last line of its output."""
    monkeypatch.chdir(tmp_path)
    run = RunFolder.create(Path("walk"), BASE, "room")
    field = GaussianField.from_values(
        torch.rand(10, 3, generator=torch.Generator().manual_seed(0)),
        torch.full((10,), 0.1),
        torch.rand(10, 3, generator=torch.Generator().manual_seed(1)),
        opacities=torch.linspace(0.05, 0.95, 10),
        log_variances=torch.linspace(0.01, 0.1, 10).square().log()[:, None],
    )
    run.write_map(field)
    run.write_trajectory(Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2)))

    def run_it(*arguments: str) -> str:
        assert exit_code("export", *arguments) == 0
        said = capsys.readouterr()
        *before, last = said.out.splitlines()
        assert [line.split()[0] for line in before] == ["writing"] * (" splats" in last), "printed before a long step"
        return last

    return run_it


@pytest.mark.parametrize("name", ["out.ply", "OUT.PLY", "out.spz"])
def test_the_ending_selects_the_format(export: Callable[..., str], name: str) -> None:
    own = "y-up" if name.endswith("spz") else "y-down"
    assert export("walk", "--out", name).startswith(f"{name}: 10 splats, axes {own}")
    assert len(read_any(Path(name))) == 10


def test_a_map_is_exported_like_a_run(export: Callable[..., str]) -> None:
    export("walk", "--out", "a.ply")
    assert export("a.ply", "--out", "b.spz").startswith("b.spz: 10 splats")
    assert export("a.ply", "--out", "c.ply").startswith("c.ply: 10 splats")
    first, last = read_any(Path("b.spz")), read_any(Path("c.ply"))
    assert sorted(first.means[:, 0].tolist()) == pytest.approx(sorted(last.means[:, 0].tolist()), abs=1e-3)


def test_the_format_can_be_given_by_name(export: Callable[..., str]) -> None:
    export("walk", "--out", "map.backup", "--format", "spz")
    assert len(read_any(Path("map.backup"))) == 10
    assert export("walk", "--format", "trajectory").startswith("walk.txt: 2 poses")
    assert len(read_poses(Path("walk.txt"))) == 2
    assert export("walk").startswith("walk.ply: 10 splats")


@pytest.fixture
def std(export: Callable[..., str]) -> SplatStd:
    """Write the uncertainty of the run's map; return the standard deviations of its splats."""
    values = torch.rand(10, 2, generator=torch.Generator().manual_seed(2)) * 1e-1
    known = SplatStd(values[:, 0].contiguous(), values[:, 1].contiguous())
    background = Background((0.5, 0.5, 0.5), 0.1, 1.0)
    RunFolder.open(Path("walk")).write_uncertainty(MapUncertainty(torch.zeros(10, 3), background, SHIPPED, std=known))
    return known


def test_a_map_has_the_standard_deviations_of_its_run(export: Callable[..., str], std: SplatStd) -> None:
    export("walk", "--out", "a.ply")
    rows = vertices(Path("a.ply"))
    np.testing.assert_array_equal(rows["depth_std_m"], std.depth_std_m)
    np.testing.assert_array_equal(rows["color_std"], std.color_std)
    assert torch.equal(ply.read_field(Path("a.ply")).params, RunFolder.open(Path("walk")).read_map().params)
    export("walk", "--out", "plain.ply", "--plain")
    assert not {"depth_std_m", "color_std"} & set(vertices(Path("plain.ply")).dtype.names)


def test_a_run_that_has_not_measured_them_is_exported_without_them(export: Callable[..., str]) -> None:
    """Runs of older versions have an uncertainty.json without standard deviations of splats."""
    background = Background((0.5, 0.5, 0.5), 0.1, 1.0)
    RunFolder.open(Path("walk")).write_uncertainty(MapUncertainty(torch.zeros(10, 3), background, SHIPPED))
    export("walk", "--out", "a.ply")
    assert vertices(Path("a.ply")).dtype == vertices(Path("walk/map.ply")).dtype


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_splats_with_a_large_standard_deviation_of_depth_are_dropped(
    export: Callable[..., str], std: SplatStd, ending: str
) -> None:
    bound = float(std.depth_std_m.median())
    wanted = std.depth_std_m < bound
    said = export("walk", "--out", f"a.{ending}", "--std-below-m", str(bound))
    kept, total = int(wanted.sum()), len(wanted)
    assert 0 < kept < total and f": {kept} splats" in said
    assert f"; dropped {total - kept} of {total}" in said
    found = read_any(Path(f"a.{ending}")).means
    theirs = RunFolder.open(Path("walk")).read_map().means[wanted]
    np.testing.assert_allclose(sorted(found[:, 0].tolist()), sorted(theirs[:, 0].tolist()), atol=2e-3)
    if ending == "ply":
        np.testing.assert_array_equal(vertices(Path("a.ply"))["depth_std_m"], std.depth_std_m[wanted])


def vertices(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return read_header(file, path)[0].read(file, path)


def test_plain_writes_only_the_columns_of_3dgs(export: Callable[..., str]) -> None:
    export("walk", "--out", "a.ply", "--plain")
    header = Path("a.ply").read_bytes().partition(b"end_header")[0]
    assert header.count(b"property float ") == 62 and b"log_variance" not in header


def test_every_format_can_be_selected_by_its_name_and_its_own_endings() -> None:
    names = [row.name for row in PLUGIN]
    assert len(set(names)) == len(names)
    for row in PLUGIN:
        assert row.endings and row.help and choose(PLUGIN, row.name, None) is row
        assert set(row.options) <= set(ExportOptions.__dataclass_fields__)
    for ending, row in owners(PLUGIN).items():
        assert choose(PLUGIN, None, Path(f"a{ending}")) is row
    assert len(listed(PLUGIN)) == len(PLUGIN)


def test_the_first_format_with_an_ending_owns_it_and_longer_endings_win() -> None:
    def nothing(source: ExportSource, target: Path) -> str:
        return ""

    first, second, longer = (Output(name, ends, "", nothing) for name, ends in
                             (("one", (".x",)), ("two", (".x",)), ("three", (".y.x",))))  # fmt: skip
    rows = (first, second, longer)
    assert choose(rows, None, Path("a.x")) is first and choose(rows, None, Path("a.y.x")) is longer
    assert choose(rows, "two", Path("a.x")) is second and choose(rows, None, None) is first
    assert listed(rows)[1].startswith("--format")


def test_default_names_of_exports(tmp_path: Path) -> None:
    (tmp_path / "room.v2.spz").touch()
    assert ExportSource(tmp_path / "room.v2.spz").name == "room.v2"
    assert ExportSource(tmp_path / "walk.1").name == "walk.1"
