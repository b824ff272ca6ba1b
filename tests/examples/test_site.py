"""The documentation's site holds every page, every name and every source that pages link to; `make docs` builds it."""

import ast
import dataclasses
import importlib
import re
import sys
from types import ModuleType, SimpleNamespace

import pytest

import sigmasplat
from documents import DOCUMENTS, ROOT
from module_files import module_from
from sigmasplat.config import Config

DOCS = ROOT / "docs"
PACKAGE = ROOT / "src" / "sigmasplat"
NOT_DOCUMENTED = {"native", "commands", "cli", "__init__", "__main__"}
"""Kernels, and what is used from the command line only."""


def theme(name: str) -> ModuleType:
    return module_from(DOCS / "theme" / f"{name}.py")


@pytest.fixture(scope="module")
def site() -> ModuleType:
    return theme("site")


def test_every_page_is_in_the_navigation(site: ModuleType) -> None:
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    named = re.findall(r"[\w/-]+\.md", nav)
    assert len(named) == len(set(named)) > 20
    pages = {*site.PAGES.values(), *(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))}
    assert pages <= set(named), f"not in mkdocs.yml: {pages - set(named)}"


def test_links_are_turned_to_the_sites_pages(site: ModuleType) -> None:
    text = "[a](../README.md) [b](../README.md#data) [c](runs.md#x) [d](../src/a.py) [e](https://x.y/z.md) [f](#here)"
    turned = (
        "[a](index.md) [b](overview.md#data) [c](runs.md#x) [d](source/src/a.py.md) [e](https://x.y/z.md) [f](#here)"
    )
    assert site.relinked(text, "docs/page.md", "page.md") == turned
    nested = "[a](../../CHANGELOG.md) [b](../runs.md) [c](model.md) ![d](../images/x.png)"
    assert site.relinked(nested, "docs/api/p.md", "api/p.md") == nested.replace("../../CHANGELOG", "../changelog")
    assert site.relinked("[a](docs/runs.md) ![](docs/images/x.png)", "README.md", "overview.md") == (
        "[a](runs.md) ![](images/x.png)"
    )
    code = "```python\nx = field[0](../README.md)\n```\n"
    assert site.relinked(code, "docs/page.md", "page.md") == code


def test_every_link_leads_to_a_page_that_is_made(site: ModuleType) -> None:
    made = site.sources()
    for path in DOCUMENTS:
        place = path.relative_to(ROOT).as_posix()
        for target in site.links(path.read_text(encoding="utf-8"), place):
            page = site.page_of(target)
            there = page in made or page in site.PAGES.values() or (DOCS / page).exists()
            assert there, f"{place} links to {target}: no page {page}"
    assert "source/examples/own_channel.py.md" in made and "source/examples.md" in made
    assert all("\ntitle: " in text for text in made.values())


def test_the_front_page_and_the_overview_are_the_readme(site: ModuleType) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    first, rest = site.first_part(readme), site.overview(readme)
    assert "make demo" in first and "docs/images/scan.jpg" in first and "## " not in first
    assert rest.startswith("# Overview\n\n## ") and readme.endswith(rest.partition("\n\n## ")[2])
    assert site.FIRST_PART in (DOCS / "index.md").read_text(encoding="utf-8")


def test_pages_that_are_not_there_are_left_out(site: ModuleType) -> None:
    nav = [{"A": ["a.md", {"B": "b.md"}]}, {"C": ["c.md"]}, "d.md"]
    assert site.present(nav, {"a.md", "d.md"}) == [{"A": ["a.md"]}, "d.md"]


def test_what_pages_load_from_elsewhere_is_noticed(site: ModuleType) -> None:
    for html in (
        '<script src="https://x.y/a.js">',
        "<link rel=stylesheet href=//x.y/a.css>",
        '<img alt="" src="http://x/a">',
    ):
        assert len(site.fetched(html)) == 1
    assert site.fetched('<a href="https://x.y/">there</a><script src="theme/a.js"></script><img src="a//b.png">') == []


def test_docstrings_are_shown_as_they_are_written(monkeypatch: pytest.MonkeyPatch) -> None:
    griffe = SimpleNamespace(Extension=object, Object=object)
    monkeypatch.setitem(sys.modules, "griffe", griffe)  # the site's tools need not be here
    escaped = theme("plain_docstrings").escaped
    assert escaped("E[c] [H, W], a * b * c, T_a_b, <name>") == r"E\[c\] \[H, W\], a \* b \* c, T\_a\_b, &lt;name>"
    assert escaped("`a_b[0]` and ``c*d``") == "`a_b[0]` and ``c*d``"
    assert escaped("layout:\n\n    x[0] * y_z\n\nend_") == "layout:\n\n    x[0] * y_z\n\nend\\_"


def test_the_api_pages_hold_every_module_and_every_public_name() -> None:
    shown = {
        name
        for page in (DOCS / "api").glob("*.md")
        for name in re.findall(r"^::: sigmasplat\.(\w+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    there = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert shown == there - NOT_DOCUMENTED
    text = (DOCS / "api" / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| (?:\[)?`(\w+)`", text, re.MULTILINE)) == set(sigmasplat.__all__)
    for target in re.findall(r"\]\[([\w.]+)\]", text):
        module, _, name = target.rpartition(".")
        assert getattr(importlib.import_module(module), name).__name__ == name, f"api/index.md: {target}"


def test_the_page_of_results_holds_all_of_them() -> None:
    assert "<!-- bench:* -->" in (DOCS / "benchmarks.md").read_text(encoding="utf-8")


def test_every_setting_has_a_sentence_of_its_own() -> None:
    settings, whole = theme("settings"), Config()
    sections = [whole, *(value for value in vars(whole).values() if dataclasses.is_dataclass(value))]
    for section in sections:
        said = settings.sentences(settings.classes()[type(section).__name__].body)
        names = {name for name, value in vars(section).items() if not dataclasses.is_dataclass(value)}
        assert names == set(said), f"{type(section).__name__}: no sentence below {sorted(names - set(said))}"
        short = [name for name, text in said.items() if len(text.split()) < 3 or not text.endswith((".", "…"))]
        assert not short, f"{type(section).__name__}: {short} should say what they do, in a sentence"


def test_the_page_of_settings_is_that_of_the_sources() -> None:
    settings = theme("settings")
    page = settings.page()
    assert (DOCS / "settings.md").read_text(encoding="utf-8") == page, "run python docs/theme/settings.py"
    rows = re.findall(r"^\| `([\w.]+)` \|(?:[^|]|\\\|)+(?:\|(?:[^|]|\\\|)*){4}$", page, re.MULTILINE)
    flat = {
        f"{name}.{inner}" for name, value in Config().to_dict().items() if isinstance(value, dict) for inner in value
    }
    assert sorted(rows) == sorted({*flat, "name", "seed", "backend"})


def test_a_setting_is_explained_by_the_text_below_it() -> None:
    fields = ("x: int = 1", "y: int = 2", '"""Two\n    lines."""', "z = 3", '"""Not a field."""')
    source = "\n    ".join(("class A:", '"""Of all."""', *fields))
    (found,) = ast.parse(source).body
    assert isinstance(found, ast.ClassDef) and theme("settings").sentences(found.body) == {"y": "Two lines."}
