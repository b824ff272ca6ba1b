"""What the documents say is true: links lead somewhere; files, functions, tests, settings and messages exist."""

import ast
import dataclasses
import importlib
import re
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from types import ModuleType

import pytest

from changed_settings import changed_settings
from documents import DOCUMENTS, ROOT, prose
from sigmasplat.config import Config
from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene
from sigmasplat.fit.compare import Comparison
from sigmasplat.plugins.presets.table_files import list_tables

README = ROOT / "README.md"
PACKAGE = ROOT / "src" / "sigmasplat"
SECTIONS = [f.name for f in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(Config(), f.name))]
FOLDERS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def anchors(path: Path) -> set[str]:
    """Return the anchors of a document's headings, made as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(path: Path) -> list[str]:
    targets = [target for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)) if not target.startswith("http")]
    broken = list[str]()
    for target in targets:
        file, _, anchor = target.partition("#")
        linked = (path.parent / file).resolve() if file else path
        if not linked.exists() or (anchor and anchor not in anchors(linked)):
            broken.append(target)
    return broken


def test_links_lead_somewhere() -> None:
    found = {str(path): broken_links(path) for path in DOCUMENTS}
    assert {path: links for path, links in found.items() if links} == {}


def unknown_names(path: Path) -> list[str]:
    """Return the tests, files, settings, presets and tables that a document names and that do not exist."""
    text = prose(path)
    tests = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text)
    files = re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w/]+\.\w+)`", text)
    settings = re.findall(rf"`({'|'.join(SECTIONS)})\.([a-z]\w+)`", text)
    presets = re.findall(r"`((?:varsplat|loopsplat|cgslam)-[a-z0-9-]*[a-z0-9])`", text)
    fitted = {"agreement", "overlap", "first_loss", "loss", "iterations", "inliers", "doubtful"}
    fitted |= {"doubt", "depth_noise", "waiting", "moving"}
    compared = {field.name for field in dataclasses.fields(Comparison)}
    logged = fitted | compared if path.name == "runs.md" else set()

    def is_known(section: str, name: str) -> bool:
        known = {*dir(getattr(Config(), section)), "py", "json", "safetensors"} | logged  # settings and constants
        return name in known or (PACKAGE / section / f"{name}.py").is_file()

    return [
        *(f"{file}::{name}" for file, name in tests if f"def {name}(" not in (ROOT / file).read_text(encoding="utf-8")),
        *(file for file in files if not (PACKAGE / file).is_file()),
        *(f"{section}.{name}" for section, name in settings if not is_known(section, name)),
        *(name for name in presets if name not in {*list_presets(), *presets_by_scene(), *list_tables()}),
    ]


def test_named_tests_files_settings_and_presets_exist() -> None:
    found = {str(path): unknown_names(path) for path in DOCUMENTS}
    assert {path: names for path, names in found.items() if names} == {}


def test_folders_that_contributors_are_sent_to_exist() -> None:
    named = set(
        re.findall(r"`([a-z_/]+/|[a-z_/]+/[a-z_]+\.py)`", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    )
    assert len(named) > 15
    assert {name for name in named if not any((ROOT / at / name).exists() for at in ("", "src/sigmasplat"))} <= {
        "site/"
    }


def test_the_functions_beside_equations_exist() -> None:
    """Every function beside a file in the papers' documents is defined there."""
    for document in ("varsplat.md", "cgslam.md"):
        text = (ROOT / "docs" / document).read_text(encoding="utf-8")
        pairs = re.findall(r"`([\w/]+/\w+\.py)` ((?:`\w+`(?:, )?)+)", text)
        assert len(pairs) > 15
        for file, names in pairs:
            tree = ast.parse((PACKAGE / file).read_text(encoding="utf-8"))
            defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
            assert set(re.findall(r"\w+", names)) <= defined, f"{document}: {file} {names}"


def test_the_fast_presets_list_is_whole() -> None:
    """docs/varsplat.md names every setting in which fast differs from the paper's, with both values."""
    tum, fast = preset("varsplat-tum"), preset("varsplat-fast")
    differing = {
        name: tuple(attrgetter(name)(config) for config in (tum, fast)) for name in changed_settings(tum, fast)
    }
    text = (ROOT / "docs" / "varsplat.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r"<!-- presets:fast varsplat -->\n(.*)\n<!-- /presets -->", text)
    found = re.findall(r"`([\w.]+)` (\S+) → ([^\s,]+)(?:, |$)", listed)
    assert "".join(f"`{name}` {old} → {new}, " for name, old, new in found) == f"{listed}, "
    assert {name: (theirs, ours) for name, theirs, ours in found} == {
        name: tuple(
            ("no", "yes")[v] if isinstance(v, bool) else f"{v:.6g}" if isinstance(v, float) else str(v) for v in values
        )
        for name, values in differing.items()
    }


def test_documented_messages_are_those_of_the_source() -> None:
    constants = {
        node.value
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    text = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+ \| (`[^|]+`) \|", text, re.MULTILINE)
    assert len(rows) > 40
    for message in re.findall(r"`([^`]+)`", "\n".join(rows)):
        for words in filter(None, (part.strip() for part in message.split("…"))):
            assert any(words in constant for constant in constants), f"errors.md: no message says {words!r}"


def test_every_warning_of_a_command_has_its_row() -> None:
    text = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")
    rows = [row.split("|")[2] for row in re.findall(r"^\|.*\| warning.*\|$", text, re.MULTILINE)]
    warned = [
        [
            part.value
            for part in ast.walk(node.args[0])
            if isinstance(part, ast.Constant) and isinstance(part.value, str)
        ]
        for file in (PACKAGE / "commands").glob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "warn"
    ]
    said = [max((part.strip() for part in parts), key=len) for parts in warned if parts]
    said = [words for words in said if len(words.split()) > 1]  # others say what a source has to say
    assert len(said) >= 3
    for words in said:
        assert any(words in row for row in rows), f"errors.md: no row of a warning says {words!r}"


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Import a program of benchmarks/."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def test_measured_tables_are_those_of_the_results(programs: Callable[[str], ModuleType]) -> None:
    tables = programs("tables")
    wanted, lacking = tables.documents()
    assert {*wanted} >= {ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "results").iterdir()}
    outdated = [path.name for path, text in wanted.items() if tables.said(path) != text]
    assert outdated == lacking == [], "run python benchmarks/tables.py"
    assert not any(tables.BLOCK.search(path.read_text(encoding="utf-8")) for path in DOCUMENTS if path not in wanted)


def test_every_committed_result_is_shown_or_judged(programs: Callable[[str], ModuleType]) -> None:
    tables, record, pages, papers = map(programs, ("tables", "record", "result_pages", "claims_papers"))
    shown = {s.name for page in pages.PAGES.values() for s in page.shown}
    shown |= {match["what"].partition("/")[0] for match in tables.BLOCK.finditer(README.read_text(encoding="utf-8"))}
    judged = {claim.evidence.results for claims in papers.PAPERS.values() for claim in claims if claim.evidence}
    committed = [record.read(path)["name"] for path in record.RESULTS.glob("*.json")]
    assert sorted(committed) == sorted(shown | judged)


def test_measured_tables_have_their_places() -> None:
    places = {"README.md": ("peers/ate-in-cm",), "docs/benchmarks.md": ("pages", "summary")}
    for document, names in places.items():
        text = (ROOT / document).read_text(encoding="utf-8")
        for name in names:
            assert re.search(rf"<!-- bench:{name} -->\n(.*\n)+?<!-- /bench -->", text), f"{document}: {name}"
    assert "\n| claim | paper |" in (ROOT / "docs" / "results" / "claims.md").read_text(encoding="utf-8")


def test_documents_with_figures_are_short_and_show_no_folders_of_a_machine() -> None:
    results = [*(ROOT / "docs" / "results").iterdir(), ROOT / "docs" / "benchmarks.md"]
    words = {path: len(path.read_text(encoding="utf-8").split()) for path in DOCUMENTS}
    assert words[README] <= 1000 and sum(words[path] for path in results) <= 14_000, words
    assert sum(count for path, count in words.items() if (ROOT / "docs") in path.parents) <= 60_000, words
    for path in (*results, README):
        assert not re.search(r"/tmp/|/work/|/home/|/root/", path.read_text(encoding="utf-8")), path.name
