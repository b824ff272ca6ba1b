"""Parse JSON and CSV that users give."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.files.guard import cause
from sigmasplat.files.reading import MOST_TEXT_BYTES, read_text

MOST_JSON_BYTES = 32 << 20
"""Largest JSON file of a recording, about 60 000 frames of nerfstudio: parsed JSON needs up to 30 times its size."""
MOST_OWN_JSON_BYTES = 512 << 20
"""Largest JSON file of a run, whose size grows with the run."""


def parse_json(text: str | bytes, where: object, error: type[SigmaSplatError] = SourceError) -> Any:
    """Parse JSON. Raises `error` naming `where` if it is not JSON, is nested too deep, or has endless numbers."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as problem:  # ValueError: not UTF-8, or a whole number of 4300 digits, too
        raise error(f"{where}: not readable as JSON ({cause(problem)}); correct it") from problem


def read_json(path: Path, error: type[SigmaSplatError] = SourceError, most: int = MOST_JSON_BYTES) -> Any:
    """Read a JSON file. Raises `error` as `read_text` and `parse_json` do."""
    return parse_json(read_text(path, error, most), path, error)


def csv_rows(
    path: Path, error: type[SigmaSplatError] = SourceError, most: int = MOST_TEXT_BYTES, errors: str = "strict"
) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, words without spaces around them) of every CSV line that is not empty.

    Raises `error` as `read_text` does, or naming the line if it is not CSV or has a field above 131 kB.
    """
    lines = csv.reader(read_text(path, error, most, errors).split("\n"))
    try:
        for words in lines:
            if words:
                yield lines.line_num, [word.strip() for word in words]
    except csv.Error as problem:
        raise error(f"{path}:{lines.line_num}: not readable as CSV ({problem}); copy it again") from problem
