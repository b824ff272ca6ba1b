"""Pages of results: what they show, what is missing, and what is out of date."""

import importlib
from pathlib import Path
from typing import Any

import pytest

from benchmark_results import results

record, result_pages, tables = map(importlib.import_module, ("record", "result_pages", "tables"))
Page, Shown = result_pages.Page, result_pages.Shown


def job(source: str, **figures: float) -> dict[str, Any]:
    return {
        "job": {"source": source, "preset": "sigma", "seed": 0},
        "problem": None,
        "peak_mib": 5.0,
        "figures": figures,
    }


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write results of two sequences, made by a command with folders of its machine; return their folder."""
    command = (
        "python benchmarks/accuracy.py --before /tmp/before/.venv/bin/sigmasplat --runs /tmp/s9/r --out /tmp/o --name x"
    )
    jobs = [job("synthetic", ate_m=0.00512), job("livingroom", ate_m=0.001)]
    record.write(results("accuracy", {"jobs": jobs}, command=command), tmp_path / "results")
    return tmp_path / "results"


def test_a_page_shows_the_chosen_tables_columns_and_rows(folder: Path) -> None:
    shown = Shown("accuracy", "What it means.", ("Path and speed",), ("preset", "livingroom"))
    text = tables.page(Page("Path", (shown,)), folder)
    assert text.startswith("# Path\n") and "\n## accuracy\n\nWhat it means.\n\n" in text
    assert "| synthetic | 1 | 0.512 |" in text and "livingroom" not in text and "Goals" not in text
    only = tables.page(Page("Path", (Shown("accuracy", "", ("Path and speed",), only=("livingroom",)),)), folder)
    assert "| livingroom | sigma | 1 | 0.100 |" in only and "| synthetic" not in only
    assert tables.page(Page("All", (Shown("accuracy", ""),)), folder).count("**Goals**") == 1


def test_commands_show_no_folders_of_the_machine(folder: Path) -> None:
    line = tables.headline(record.latest("accuracy", folder))
    assert (
        line.endswith("`python benchmarks/accuracy.py --before PATH/sigmasplat --name x`")
        and "commit 012345678" in line
    )


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        (Shown("gpu", ""), "'gpu', which are not there"),
        (Shown("accuracy", "", ("Speed",)), "no 'Speed'"),
        (Shown("accuracy", "", without=("colour",)), "no 'colour'"),
        (Shown("accuracy", "", only=("kitchen",)), "no 'kitchen'"),
    ],
)
def test_what_a_page_cannot_show_is_named(shown: Any, words: str, folder: Path) -> None:
    with pytest.raises(KeyError, match=words):
        tables.page(Page("Path", (shown,)), folder)


def test_outdated_missing_and_stray_documents_are_found_and_repaired(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    accuracy = tables.layout("accuracy")
    monkeypatch.setattr(tables, "layout", lambda benchmark: accuracy)
    monkeypatch.setattr(tables, "PAGES", {"path": Page("Path", (Shown("accuracy", ""),))})
    monkeypatch.setattr(record, "ROOT", tmp_path)
    wanted = tables.documents
    monkeypatch.setattr(tables, "documents", lambda: wanted(tmp_path, folder))
    (tmp_path / "docs" / "results").mkdir(parents=True)
    block = "<!-- bench:accuracy/path-and-speed -->\n{}<!-- /bench -->\n"
    (tmp_path / "README.md").write_text(block.format("old\n"))
    (tmp_path / "docs" / "results" / "stray.md").write_text("old")
    assert tables.main(check=True) == 1
    assert sorted(line.split(": ")[1] for line in capsys.readouterr().out.splitlines()) == [
        "README.md", "docs/results/path.md", "docs/results/stray.md",
    ]  # fmt: skip
    assert (tmp_path / "docs" / "results" / "stray.md").exists()
    assert tables.main() == 0 and tables.main(check=True) == 0
    assert [path.name for path in (tmp_path / "docs" / "results").iterdir()] == ["path.md"]
    page = tmp_path / "docs" / "results" / "path.md"
    page.write_text(page.read_text().replace("0.512", "0.511"))
    assert tables.main(check=True) == 1
    (tmp_path / "README.md").write_text("<!-- bench:gpu -->\n<!-- /bench -->\n")
    assert tables.main(check=True) == 1 and "no results 'gpu' yet" in capsys.readouterr().err
    record.latest("accuracy", folder)
    next(folder.glob("*.json")).unlink()
    assert tables.main(check=True) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_links_lead_to_the_page_that_shows_the_results() -> None:
    assert result_pages.link("accuracy", "results/") == "[accuracy](results/path.md#accuracy)"
    assert result_pages.link("verdicts") == "[verdicts](claims.md#verdicts)"
    assert result_pages.link("not shown") == "not shown"
    listed = tables.list_of_pages()
    assert all(
        result_pages.link(s.name, "results/") in listed for page in result_pages.PAGES.values() for s in page.shown
    )


def test_every_result_shown_has_a_sentence_and_one_place() -> None:
    shown = [s for page in result_pages.PAGES.values() for s in page.shown]
    assert len({s.name for s in shown}) == len(shown) > 30
    assert all(s.meaning.endswith(".") and len(s.meaning.split()) > 5 and ". " not in s.meaning for s in shown)
