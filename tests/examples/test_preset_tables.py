"""The tables of presets in the documents: made by docs/theme/presets.py, up to date, and complete."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from changed_settings import changed_settings
from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene
from sigmasplat.plugins.presets.shared_by_papers import BASE

DOCS = Path(__file__).parents[2] / "docs"
SYSTEMS = ("varsplat", "cgslam")


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    monkeypatch.delitem(sys.modules, "presets", raising=False)
    return importlib.import_module("presets")


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_tables_are_those_of_the_presets(tables: ModuleType, system: str) -> None:
    text = (DOCS / f"{system}.md").read_text(encoding="utf-8")
    assert tables.rewritten(text) == text, "run python docs/theme/presets.py"
    for kind in ("paper", "methods", "scenes"):
        assert text.count(f"<!-- presets:{kind} {system} -->") == 1


@pytest.mark.parametrize("system", SYSTEMS)
def test_each_setting_of_a_papers_preset_has_an_origin(tables: ModuleType, system: str) -> None:
    origins, columns = tables.ORIGINS[system], tables.DATA_SETS[system]
    for column in columns:
        missing = changed_settings(preset(f"{system}-{column}"), BASE) - set(origins)
        assert missing == set(), f"{system}-{column}: no row in docs/theme/presets.py"
    for name, origin in origins.items():
        usual, _, others = origin.partition("; ")
        datasets, _, other = others.partition(": ")
        assert usual in ("paper", "code", "ours") and other in ("", "paper", "code", "ours"), name
        assert not others or set(datasets.split(", ")) < set(columns), name


@pytest.mark.parametrize("system", SYSTEMS)
def test_each_setting_of_a_released_preset_is_in_a_table(tables: ModuleType, system: str) -> None:
    """Each setting in which a scene differs from the paper's presets is a column or a row of the code's tables."""
    names = [name for name in presets_by_scene() if name.startswith(f"{system}-")]
    shown = {line.split("`")[1] for line in tables.method_table(system).splitlines() if line.startswith("| `")}
    for name in names:
        differing = set.intersection(
            *(changed_settings(preset(name), preset(f"{system}-{column}")) for column in tables.DATA_SETS[system])
        )
        assert differing <= shown | set(tables.SCENES[system]), name


def test_every_preset_is_named_on_a_page_of_its_system() -> None:
    for name in [*list_presets(), *presets_by_scene()]:
        page = "varsplat" if name.split("-")[0] in ("varsplat", "loopsplat") else "cgslam"
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        scene = name.partition("-released-")[2]
        assert f"`{scene or name}`" in text, name
