"""Find the definitions of the tables of papers: one TOML file per table in `tables/` (docs/tables.md)."""

import tomllib
from pathlib import Path
from typing import Any

from sigmasplat.api import ConfigError, guarded, nearest, read_text

TABLES = Path(__file__).parent / "tables"


def list_tables() -> list[str]:
    """List the names of all tables."""
    return sorted(path.stem for path in TABLES.glob("*.toml"))


def read_table(name: str) -> dict[str, Any]:
    """Read a definition, by its name or by the path of a .toml file. Raises ConfigError if it cannot be read."""
    path = Path(name) if name.endswith(".toml") else TABLES / f"{name}.toml"
    if path.parent == TABLES and name not in list_tables():
        raise ConfigError(f"no table {name!r}{nearest(name, list_tables())}; known: {', '.join(list_tables())}")
    text = read_text(path, ConfigError)
    with guarded(f"cannot read the table {path}", "docs/tables.md shows a definition", ConfigError, "not TOML"):
        return tomllib.loads(text)
