"""Write docs/settings.md, a table of all settings: PYTHONPATH=src python docs/theme/settings.py.

The descriptions are the docstrings in `config`; types and values are those of the program. A test compares the page
with the output of this script.
"""

import ast
import dataclasses
import itertools
import sys
from functools import cache
from pathlib import Path
from typing import Any, get_args

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "settings.md"
HEAD = """# Settings

`--set SECTION.NAME=VALUE` changes a setting of a command that reads a recording, of `demo` or of `bench`. The
`config.json` of a run has all settings that it used. The defaults are the preset `sigma`. Units are in the names: `_m`
metres, `_deg` degrees, `_px` pixels, `_s` seconds. `lr_` is a learning rate, `weight_` the weight of a loss. § is a
heading of [varsplat.md](varsplat.md) or [cgslam.md](cgslam.md). "Ours" marks what is in neither paper. *Takes* is the
type and the valid range; `on` and `off` mean `true` and `false`. *Changed by* names the presets with another value
(*all*: cgslam, loopsplat and varsplat; [which value](paper-values.md)). Names of this form that are not listed here,
such as `tracking.lost_share`, are fixed values. A value out of range is refused.

Generated from [`config/`](../src/sigmasplat/config/) by `docs/theme/settings.py`. Back to the [README](../README.md).
"""


def sentences(body: list[ast.stmt]) -> dict[str, str]:
    """Return the docstring below each field, by the name of the field."""
    said = {_field(node): _text(below) for node, below in itertools.pairwise(body)}
    return {name: " ".join(text.split()) for name, text in said.items() if name and text}


def classes() -> dict[str, ast.ClassDef]:
    """Return the classes of the modules in `config`, by name."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "src/sigmasplat/config").glob("*.py")]
    return {node.name: node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)}


def changed_by(section: str, name: str) -> str:
    """Return the systems of which a preset has another value than the default; "all" for all of them."""
    values = {system: [getattr(getattr(c, section), name) for c in configs] for system, configs in presets().items()}
    default = values.pop("sigma")[0]
    changed = [system for system, found in values.items() if any(value != default for value in found)]
    return "all" if len(changed) == len(values) else ", ".join(changed)


@cache
def presets() -> dict[str, list[Any]]:
    """Return the settings of all presets by system, the first word of the name."""
    from sigmasplat.config.find_preset import list_presets, preset, presets_by_scene

    found: dict[str, list[Any]] = {}
    for name in [*list_presets(), *presets_by_scene()]:
        found.setdefault(name.partition("-")[0], []).append(preset(name))
    return found


def table(defaults: Any, section: str = "") -> str:
    """Return the table of one section: a row per field that is not a section itself."""
    from sigmasplat.config.ranges import kinds_of

    said, kinds = sentences(classes()[type(defaults).__name__].body), kinds_of(type(defaults))
    rows = ["| setting | takes | default | changed by | meaning |", "|---|---|---|---|---|"]
    prefix = f"{section}." if section else ""
    for name in (field.name for field in dataclasses.fields(defaults)):
        value = getattr(defaults, name)
        if not dataclasses.is_dataclass(value):
            sentence = said.get(name, "").replace("|", "\\|")
            systems = changed_by(section, name) if section else ""
            rows.append(f"| `{prefix}{name}` | {_words(kinds[name])} | {_written(value)} | {systems} | {sentence} |")
    return "\n".join(rows) + "\n"


def page() -> str:
    """Return the whole page."""
    from sigmasplat.config import Config

    defaults = Config()
    parts = [HEAD, f"## Whole run\n\n{table(defaults)}"]
    for field in dataclasses.fields(defaults):
        section = getattr(defaults, field.name)
        if dataclasses.is_dataclass(section):
            said = " ".join((ast.get_docstring(classes()[type(section).__name__]) or "").split())
            rows = table(section, field.name)
            parts.append(f"## {field.name}\n\n{said.partition(' Raises ')[0]}\n\n{rows}")
    return "\n".join(parts)


def _field(node: ast.stmt) -> str:
    """Return the name of the setting that a statement declares, "" for a constant and any other statement."""
    match node:
        case ast.AnnAssign(annotation=ast.Subscript(value=ast.Name(id="ClassVar"))):
            return ""
        case ast.AnnAssign(target=ast.Name(id=name)):
            return name
    return ""


def _text(node: ast.stmt) -> str:
    """Return the text of a string statement, "" for any other statement."""
    match node:
        case ast.Expr(value=ast.Constant(value=str(text))):
            return text
    return ""


def _words(kind: Any) -> str:
    from sigmasplat.config.ranges import unpacked

    base, range_ = unpacked(kind)
    if choices := get_args(base):  # Literal["a", "b"]
        return ", ".join(f"`{choice}`" for choice in choices)
    name = {int: "integer", float: "number", bool: "`true`, `false`", str: "text"}[base]
    words = str(range_ or "").replace("between ", "").replace(" and ", " to ").replace("at least", "≥")
    return f"{name} {words.replace('above', '>').replace('finite', '')}".strip()


def _written(value: Any) -> str:
    if isinstance(value, str):
        return f"`{value}`" if value else "empty"
    return str(value).lower() if isinstance(value, bool) else f"{value:.6g}"


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    PAGE.write_text(page(), encoding="utf-8")
