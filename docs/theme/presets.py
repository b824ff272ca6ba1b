"""Write docs/paper-values.md, and the list of docs/varsplat.md: PYTHONPATH=src python docs/theme/presets.py.

The values are those of the presets; where each one comes from is in sources.toml. A test compares the documents with
the output of this script, and checks that no setting of a preset is left out.
"""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "src" / "sigmasplat" / "plugins" / "presets" / "scenes"
PAGE, LISTS = ROOT / "docs" / "paper-values.md", ROOT / "docs" / "varsplat.md"
SOURCES: dict[str, dict[str, Any]] = tomllib.loads((Path(__file__).parent / "sources.toml").read_text(encoding="utf-8"))
FAMILIES = ("varsplat", "varsplat-released", "cgslam", "cgslam-released")
HEAD = """# Values of the papers' presets

`varsplat-DATASET` and `cgslam-DATASET` are the text with its supplement; what it leaves open is the released code's.
`varsplat-released-SCENE` and `cgslam-released-SCENE` are the released code, with the values of each scene
(`plugins/presets/scenes/`); their rows say what differs from the text's. `loopsplat-DATASET` is `varsplat-DATASET`
without any use of σ².

*text*: the paper with its supplement; *supplement*: a table of it; *code*: a file of the released code; *ours*: neither
states a value. Settings that are not listed have [their defaults](settings.md). Differences in method:
[VarSplat](varsplat.md#deviations), [CG-SLAM](cgslam.md#deviations). Generated from
[`sources.toml`](theme/sources.toml) by `docs/theme/presets.py`.

"""
OFF = """
## What is ours is off

A test holds these settings and rules at the values with which they are off, in all presets of the papers:

"""


def presets_of(family: str) -> dict[str, Any]:
    """Return the settings of a family by data set, or by scene for the released code."""
    from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene

    names = presets_by_scene() if family.endswith("-released") else list_presets()
    found = [name for name in names if name.startswith(f"{family}-") and not name.endswith("-fast")]
    others = ("cgslam-light-", "cgslam-loops-")
    return {name.removeprefix(f"{family}-"): preset(name) for name in found if not name.startswith(others)}


def row(family: str, setting: str) -> str:
    """Return a row of the table: the setting, the family, its values, and their source."""
    values: dict[str, list[str]] = {}
    for name, config in presets_of(family).items():
        values.setdefault(shown(config, setting), []).append(name)
    groups = [f"{value}: {', '.join(in_short(family, names))}" for value, names in values.items()]
    cell = "; ".join(groups) if len(groups) > 1 else next(iter(values))
    source = re.sub(r"[\w*.-]+/[\w*./-]+|\w+\.py", r"`\g<0>`", SOURCES[family][setting])
    return f"|`{setting}`|{family}|{cell}|{source}|"


def scenes_of(paper: str) -> dict[str, Any]:
    """Return the table of the scenes of a paper's code; like: the data set of a scene."""
    return tomllib.loads((SCENES / f"{paper}.toml").read_text(encoding="utf-8"))


def in_short(family: str, names: list[str]) -> list[str]:
    """Return some names of a family, with the name of a data set for all of its scenes."""
    if not family.endswith("-released"):
        return names
    scenes: dict[str, list[str]] = {}
    for scene, values in scenes_of(family.removesuffix("-released")).items():
        scenes.setdefault(values["like"], []).append(scene)
    whole = [dataset for dataset, its in scenes.items() if set(its) <= set(names)]
    return whole + [name for name in names if not any(name in scenes[dataset] for dataset in whole)]


def page() -> str:
    """Return the whole page: one row per setting and family, in the order of the settings."""
    settings = dict.fromkeys(name for family in FAMILIES for name in SOURCES[family])
    sections = list(presets_of("varsplat")["tum"].to_dict())
    ordered = sorted(settings, key=lambda name: sections.index(name.partition(".")[0]))
    table = ["| setting | family | value | source |", "|---|---|---|---|"]
    table += [row(family, name) for name in ordered for family in FAMILIES if name in SOURCES[family]]
    off = ", ".join(f"`{name}` {written(value)}" for name, value in SOURCES["ours"].items())
    return HEAD + "\n".join(table) + "\n" + OFF + off + "\n"


def fast_list() -> str:
    """Return the settings in which VarSplat's preset for two CPU cores differs from that for TUM: both values."""
    from sigmasplat.config.find_preset import preset

    theirs, ours = preset("varsplat-tum"), preset("varsplat-fast")
    changed = []
    for section, values in ours.to_dict().items():
        for name in (f"{section}.{inner}" for inner in (values if isinstance(values, dict) else ())):
            if (value := shown(ours, name)) != (other := shown(theirs, name)):
                changed.append(f"`{name}` {other} → {value}")
    return ", ".join(changed)


def with_list(text: str) -> str:
    """Return a document with the list between <!-- presets:fast varsplat --> and <!-- /presets --> made again."""
    made = f"<!-- presets:fast varsplat -->\n{fast_list()}\n<!-- /presets -->"
    return re.sub(r"<!-- presets:fast varsplat -->.*?<!-- /presets -->", lambda _: made, text, flags=re.DOTALL)


def value_of(config: Any, name: str) -> Any:
    """Return the value of a setting, or of what follows from it, by its name SECTION.NAME."""
    section, _, setting = name.partition(".")
    return getattr(getattr(config, section), setting)


def shown(config: Any, name: str) -> str:
    """Return a value as the documents write it."""
    return written(value_of(config, name))


def written(value: Any) -> str:
    """Return a value as the documents write it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    PAGE.write_text(page(), encoding="utf-8")
    LISTS.write_text(with_list(LISTS.read_text(encoding="utf-8")), encoding="utf-8")
