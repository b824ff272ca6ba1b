"""Show docstrings as they are written: plain text, in which brackets are shapes and stars are products (for Griffe)."""

import re
from typing import Any

import griffe

MARKS = re.compile(r"(`+[^`]*`+)|([\\*_<\[\]])")


def escaped(text: str) -> str:
    """Return a docstring as Markdown that shows it; code between backticks and blocks set in by four are left."""
    return "\n".join(
        line if line.startswith("    ") else MARKS.sub(lambda m: m[1] or ("&lt;" if m[2] == "<" else f"\\{m[2]}"), line)
        for line in text.splitlines()
    )


class PlainDocstrings(griffe.Extension):
    """Escape every docstring when it is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Escape an object's own."""
        if obj.docstring is not None:
            obj.docstring.value = escaped(obj.docstring.value)
