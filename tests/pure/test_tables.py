"""Tables of papers: every definition is valid, means and deviations follow from the runs, mistakes are one line."""

from pathlib import Path
from typing import Any

import pytest

from command_line import exit_code
from sigmasplat.config.find_preset import preset
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.plugins.batch.batch import Batch
from sigmasplat.plugins.batch.definition import MEAN, Cell, Score, Table
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.batch.scores import OURS, PAPER, Written, rows
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.plugins.presets.table_files import list_tables

WANTED = {
    "varsplat-replica", "varsplat-tum", "varsplat-scannet", "varsplat-scannetpp", "varsplat-ablation",
    "varsplat-runtime", "varsplat-variance", "cgslam-replica", "cgslam-tum", "cgslam-ablation", "cgslam-runtime",
}  # fmt: skip
DEFINITION = """
title = "Two rooms"
[[scenes]]
name = "a"
path = "a"
[[scenes]]
name = "b"
path = "inner/b"
[[systems]]
name = "ours & theirs"
preset = "sigma"
[[scores]]
name = "ATE"
keys = ["ate_new.rmse_m", "ate.rmse_m"]
unit = "cm"
factor = 100
[[published]]
system = "ours & theirs"
source = "a paper"
[published.scores]
"ATE" = { a = 1.5, mean = 2 }
[[published]]
system = "another"
source = "a paper"
[published.scores]
"ATE" = { b = 7 }
"""


@pytest.fixture
def table(tmp_path: Path) -> Table:
    (tmp_path / "rooms.toml").write_text(DEFINITION)
    return Table.read(str(tmp_path / "rooms.toml"))


def ate(value_m: float | None) -> dict[str, Any]:
    return {"ate": None if value_m is None else {"rmse_m": value_m}}


@pytest.mark.parametrize("name", list_tables())
def test_every_definition_is_valid(name: str) -> None:
    table = Table.read(name)
    cells = table.cells(2, {"mapping.iterations": "1"})
    assert len({cell.job.name for cell in cells}) == len(cells) == 2 * len(table.scenes) * len(table.systems)
    assert {cell.job.config.mapping.iterations for cell in cells} == {1}
    shown = {system.name for system in table.systems} & {published.system for published in table.published}
    assert shown, "no system of the paper is run"
    for published in table.published:
        for numbers in published.scores.values():
            scenes = [numbers[scene.name] for scene in table.scenes if scene.name in numbers]
            if MEAN in numbers and len(scenes) == len(table.scenes):
                assert numbers[MEAN] == pytest.approx(sum(scenes) / len(scenes), rel=0.06), (
                    published.system
                )  # a paper rounds


def test_the_tables_of_both_papers_exist() -> None:
    assert set(list_tables()) >= WANTED


def test_systems_of_an_ablation_differ(table: Table) -> None:
    for name in ("varsplat-ablation", "cgslam-ablation"):
        systems = [
            cell.job.config for cell in Table.read(name).cells(1, {}) if cell.scene == Table.read(name).scenes[0].name
        ]
        assert len(set(map(str, systems))) == len(systems)


def test_means_and_deviations_over_seeds(table: Table) -> None:
    cells = table.cells(2, {})
    values = {("a", 0): 0.01, ("a", 1): 0.03, ("b", 0): 0.05, ("b", 1): 0.07}
    records = {cell.job.name: ate(values[cell.scene, cell.seed]) for cell in cells}
    other, paper, ours = rows(table, cells, records)
    assert (other.system, other.origin, other.values["b"].mean) == ("another", PAPER, 7)
    assert (paper.origin, paper.values[MEAN].mean) == (PAPER, 2)
    assert ours.origin == OURS
    assert ours.values["a"].mean == pytest.approx(2) and ours.values["a"].deviation == pytest.approx(2**0.5)
    assert ours.values[MEAN].mean == pytest.approx(4) and ours.values[MEAN].deviation == pytest.approx(2**0.5)
    assert ours.values[MEAN].scenes is None


def test_a_mean_says_how_many_scenes_it_covers(table: Table) -> None:
    cells = table.cells(1, {})
    *_, ours = rows(table, cells, {cells[0].job.name: ate(0.02)})
    assert set(ours.values) == {"a", MEAN} and ours.values[MEAN].scenes == 1


def test_no_mean_leaves_out_a_missing_score(table: Table) -> None:
    """As of a run with an empty mesh, or of one that failed."""
    cells = table.cells(2, {})
    records = {cell.job.name: {} if (cell.scene, cell.seed) == ("b", 1) else ate(0.02) for cell in cells}
    *_, ours = rows(table, cells, records)
    assert ours.values["a"].mean == 2 and ours.values["b"].mean is None and ours.values[MEAN].mean is None
    text = Written(table, cells, [ours], [], {}).markdown()
    assert "| 2.00 ± 0.00 | missing (1 of 2 seeds) | missing (1 of 2 seeds) |" in text


def test_the_first_key_with_a_value_is_taken(table: Table) -> None:
    (score,) = table.scores
    assert score.value(ate(0.02) | {"ate_new": {"rmse_m": 0.03}}) == 3
    assert score.value(ate(0.02)) == 2 and score.value({"ate": "strange"}) is None and score.value({}) is None


def test_text_of_a_table(table: Table) -> None:
    cells: list[Cell] = table.cells(1, {})
    made = Written(table, cells, rows(table, cells, {cells[0].job.name: ate(0.02)}), ["Missing: b."], {})
    text = made.markdown()
    assert "| ATE [cm] ↓ | ours & theirs (ours) | 2.00 | – | 2.00 (1 of 2 scenes) |" in text and "- Missing: b." in text
    assert "| ATE [cm] ↓ | ours & theirs (paper) | 1.50 | – | 2.00 |" in text
    assert made.values()["rows"][2]["values"]["a"]["mean"] == pytest.approx(2)


def test_scenes_are_found_in_the_folders_of_a_table(tmp_path: Path) -> None:
    job = Job("x", ("room0", "Replica/room0"), BASE)
    with pytest.raises(SourceError, match="no room0 in"):
        job.sequence(str(tmp_path))
    (tmp_path / "Replica/room0").mkdir(parents=True)
    assert job.sequence(str(tmp_path)) == str((tmp_path / "Replica/room0").resolve())
    (tmp_path / "room0").mkdir()
    assert job.sequence(str(tmp_path)) == str((tmp_path / "room0").resolve())
    assert Job.from_json(job.to_json()) == job


def test_scenes_and_systems_can_be_chosen(table: Table) -> None:
    part = table.with_systems(["sigma"])
    assert [(cell.scene, cell.system) for cell in part.cells(1, {}, scenes=["b"])] == [("b", "sigma")]
    assert table.with_systems([]) == table
    with pytest.raises(ConfigError, match="no scene 'c'"):
        table.cells(1, {}, scenes=["c"])
    with pytest.raises(ConfigError, match="no system 'quick'"):
        table.with_systems(["quick"])


def test_a_preset_by_scene_is_chosen_for_all_scenes() -> None:
    tum = Table.read("varsplat-tum").with_systems(["varsplat-released-{scene}"])
    configs = {cell.scene: cell.job.config for cell in tum.cells(1, {})}
    assert len(configs) == 5 and all(
        preset(f"varsplat-released-{scene}").tracking == config.tracking for scene, config in configs.items()
    )
    with pytest.raises(ConfigError, match=r"no system 'varsplat-release-\{scene\}' \(did you mean varsplat-released"):
        Table.read("varsplat-tum").with_systems(["varsplat-release-{scene}"])


@pytest.mark.parametrize(
    ("scene", "system", "score", "published"),
    [
        ("room0", "VarSplat", "ATE, keyframes", 0.2), ("office3", "LoopSplat", "ATE, keyframes", 0.2),
        ("fr2-xyz", "LoopSplat", "PSNR", 22.68), ("fr3-office", "VarSplat", "LPIPS", 0.248),
        ("scene0207", "VarSplat", "ATE, keyframes", 6.2), ("281bc17764", "VarSplat", "novel view PSNR", 21.92),
        ("fr1-room", "CG-SLAM", "ATE, all frames", 9.39), ("office1", "MonoGS", "ATE, keyframes", 0.19),
        (MEAN, "row IV", "ATE, keyframes", 7.51), (MEAN, "row II", "ATE, keyframes", 7.17),
    ],
)  # fmt: skip
def test_published_numbers_stand_by_scene(scene: str, system: str, score: str, published: float) -> None:
    found = [
        row.scores[score][scene]
        for row in (row for name in list_tables() for row in Table.read(name).published)
        if row.system == system and scene in row.scores.get(score, {})
    ]
    assert published in found


def test_a_table_says_what_was_replaced(tmp_path: Path) -> None:
    table = Table.read("varsplat-tum").with_systems(["VarSplat", "sigma"])

    def lines(*changes: str) -> str:
        cells = table.cells(1, dict(change.split("=") for change in changes))
        return "\n".join(Written.of(table, cells, Batch([], tmp_path), 1, {}, None).lines)

    assert "Replaced: NetVLAD by the built-in descriptor, in VarSplat; to use NetVLAD: sigmasplat download" in lines()
    assert "Replaced" not in lines("loops.weights=net.mat")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["cgslam-replca", "--data", "."], "no table 'cgslam-replca'"),
        (["cgslam-replica"], "no --data given"),
        (["cgslam-replica", "--data", "/nowhere"], "no scene of cgslam-replica was found"),
        (["cgslam-replica", "--data", ".", "--jobs", "0"], "--jobs must be at least 1"),
        (["cgslam-replica", "--data", ".", "--seeds", "0"], "--seeds must be at least 1"),
        (["/no/such.toml", "--data", "."], "cannot read /no/such.toml: No such file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_are_one_line(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code("bench", "table", *arguments) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_wrong_definition_is_refused(tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text(DEFINITION.replace("{ b = 7 }", "{ c = 7 }"))
    with pytest.raises(ConfigError, match="another has numbers of 'c'"):
        Table.read(str(tmp_path / "wrong.toml"))
    (tmp_path / "wrong.toml").write_text(DEFINITION.replace("path =", "pth ="))
    with pytest.raises(ConfigError, match="not valid"):
        Table.read(str(tmp_path / "wrong.toml"))


def test_the_list_of_tables_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("bench", "table", "list") == 0
    assert {line.split()[0] for line in capsys.readouterr().out.splitlines()} == set(list_tables())


def test_scores_say_which_direction_is_better() -> None:
    assert {score.better for name in list_tables() for score in Table.read(name).scores} == {"less", "more"}
    assert Score("x", ["a"], "cm").title == "x [cm] ↓" and Score("x", ["a"], better="more").title == "x ↑"
