"""The table of the papers' values: made by docs/theme/presets.py, up to date, complete, with a source in each row."""

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from changed_settings import changed_settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene

DOCS = Path(__file__).parents[2] / "docs"
PART = r"(text|supplement|code|ours)( \([a-z, ]+\))?(: [^;]+)?"
PAGES = {"varsplat": "varsplat.md", "loopsplat": "varsplat.md", "cgslam": "cgslam.md", "sigma": "cgslam.md"}


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    monkeypatch.delitem(sys.modules, "presets", raising=False)
    return importlib.import_module("presets")


def test_the_page_is_that_of_the_presets(tables: ModuleType) -> None:
    assert tables.PAGE.read_text(encoding="utf-8") == tables.page(), "run python docs/theme/presets.py"
    text = tables.LISTS.read_text(encoding="utf-8")
    assert tables.with_list(text) == text, "run python docs/theme/presets.py"


def test_each_source_says_what_it_is(tables: ModuleType) -> None:
    for family in tables.FAMILIES:
        for name, source in tables.SOURCES[family].items():
            assert re.fullmatch(rf"{PART}(; {PART})*", source), f"{family}: {name} is from {source!r}"
            files = re.findall(r"code[^;:]*: ([^;,]+)", source)
            assert source.count("code") == len(files), f"{family}: {name} does not name the file of the code"


def test_each_setting_of_a_papers_preset_has_a_source_or_is_off(tables: ModuleType) -> None:
    """Each setting that differs from the default is in the table of its family, or a rule of ours that is off."""
    for family in ("varsplat", "cgslam"):
        for name, config in tables.presets_of(family).items():
            missing = changed_settings(config, Config()) - {*tables.SOURCES[family], *tables.SOURCES["ours"]}
            assert missing == set(), f"{family}-{name}: no row in docs/theme/sources.toml"


def test_the_rows_of_the_code_are_what_differs_from_the_text(tables: ModuleType) -> None:
    for family in ("varsplat", "cgslam"):
        texts, released = tables.presets_of(family), tables.presets_of(f"{family}-released")
        shown, differing = set(tables.SOURCES[f"{family}-released"]), set[str]()
        for scene, row in tables.scenes_of(family).items():
            config, text = released[scene], texts[row["like"]]
            assert changed_settings(config, text) <= shown, f"{family}-released-{scene}: no row in sources.toml"
            differing |= {name for name in shown if tables.value_of(config, name) != tables.value_of(text, name)}
        assert differing == shown, f"{family}-released: a row that says nothing new"


def test_every_preset_is_named_on_a_page_of_its_system(tables: ModuleType) -> None:
    for name in list_presets():
        assert f"`{name}`" in (DOCS / PAGES[name.split("-")[0]]).read_text(encoding="utf-8"), name
    text = tables.PAGE.read_text(encoding="utf-8")
    for name in presets_by_scene():
        scene = name.partition("-released-")[2]
        assert re.search(rf"\b{scene}\b", text), name
        assert preset(name).name == name
