"""Draw docs/images/floors.svg, the layers of the package and their imports: python docs/theme/floors.py.

The imports are read from the sources. `FLOORS` is the one list of the layers; tests/pure/test_layers.py enforces it and
checks that the committed picture shows the current imports.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "sigmasplat"
PICTURE = ROOT / "docs" / "images" / "floors.svg"


@dataclass(frozen=True)
class Floor:
    """One layer: the folders or top files in it, the group it belongs to, and its contents."""

    names: tuple[str, ...]
    group: str
    what: str

    @property
    def label(self) -> str:
        """Return the name shown in the picture."""
        return " ".join(name for name in self.names if not name.startswith("__"))


FLOORS = (
    Floor(("errors", "env", "types"), "base", "errors, environment, shared types"),
    Floor(("registry",), "base", "plug-ins: rows of six kinds"),
    Floor(("files",), "base", "read and write files, within limits"),
    Floor(("config",), "base", "every setting, with units; presets"),
    Floor(("native",), "base", "C++ and CUDA kernels, threads"),
    Floor(("data",), "core", "camera, frame, splats, submap, poses"),
    Floor(("render",), "core", "images: colour, depth, variance"),
    Floor(("fit",), "core", "optimise poses and splats"),
    Floor(("tracking",), "core", "find the camera in the map"),
    Floor(("mapping",), "core", "seed, fit and prune the map"),
    Floor(("graph",), "core", "loops, pose graph, covariance"),
    Floor(("slam",), "core", "the main loop and its state"),
    Floor(("uncertainty",), "programs", "how sure the map is"),
    Floor(("final",), "programs", "the last map"),
    Floor(("system",), "programs", "loop, arrays, events, last map"),
    Floor(("realtime",), "programs", "the same on two clocks"),
    Floor(("input",), "programs", "what a recording is; opens one"),
    Floor(("run_folder",), "programs", "the files of a run"),
    Floor(("run",), "programs", "run SLAM on a sequence"),
    Floor(("api",), "plugins", "all that plug-ins import"),
    Floor(("plugins",), "plugins", "sources, outputs, viewer, scores, …"),
    Floor(("commands",), "programs", "one module per command"),
    Floor(("cli", "__init__", "__main__"), "programs", "command line and public names"),
)
"""From top to bottom: a file imports only from its own layer and from those above it."""

ROW, COLUMN, LEFT, TOP = 25, 22, 578, 34
NAME, WHAT = 100, 200
"""Where the name and the contents of a layer begin."""
WIDTH = LEFT + COLUMN * len(FLOORS) + 62
STYLE = """
text { font: 13px system-ui, sans-serif; fill: #1f2328 }
.name { font: bold 13px ui-monospace, monospace }
.quiet, .size, .head { fill: #59636e }
.size { text-anchor: end }
.head { font-size: 11.5px }
.line { stroke: #d1d9e0 }
.guide { stroke: #d1d9e0; stroke-opacity: 0.6 }
.dot { fill: #59636e }
.base { fill: #8c959f } .core { fill: #0969da } .plugins { fill: #bc4c00 }
.programs { fill: #8250df }
@media (prefers-color-scheme: dark) {
  text { fill: #e6edf3 }
  .quiet, .size, .head { fill: #9198a1 }
  .line { stroke: #3d444d }
  .guide { stroke: #3d444d; stroke-opacity: 0.6 }
  .dot { fill: #b1bac4 }
  .base { fill: #9198a1 } .core { fill: #4493f8 } .plugins { fill: #f0883e }
  .programs { fill: #ab7df8 }
}
"""


@cache
def imported(tree: ast.AST) -> tuple[str, ...]:
    """Return every module, or name in one, that a file imports, dotted; at the top or inside a function. A name of the
    API, `api.name` too, is that of its home."""
    found = list[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name != "sigmasplat.api"]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "api":
            found.append(f"{api_homes()[node.attr]}.{node.attr}")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute, so that the layers can be read"
            homes = api_homes() if node.module == "sigmasplat.api" else {}
            found += [f"{homes.get(alias.name, node.module)}.{alias.name}" for alias in node.names]
    return tuple(found)


@cache
def api_homes() -> dict[str, str]:
    """Return the module of each name of the API."""
    body = ast.parse((PACKAGE / "api.pyi").read_text(encoding="utf-8")).body
    return {alias.name: str(node.module) for node in body if isinstance(node, ast.ImportFrom) for alias in node.names}


@cache
def parsed(path: Path) -> ast.AST:
    """Parse a file. Of the registry only what it imports when it runs: its rows name types of all layers."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if path == PACKAGE / "registry.py":
        tree.body = [part for part in tree.body if not (isinstance(part, ast.If) and "TYPE_CHECKING" in ast.dump(part))]
    return tree


def folder_of(path: Path) -> str:
    """Return the folder of the package a file is in, or the file's own name at the top."""
    return path.relative_to(PACKAGE).parts[0].partition(".")[0]


def sources(floor: Floor, endings: str = "py|pyi|h|cpp|cu|cuh") -> list[Path]:
    """List the source files of a layer."""
    found = (path for path in PACKAGE.rglob("*") if re.fullmatch(rf".*\.({endings})", path.name))
    return sorted(path for path in found if folder_of(path) in floor.names)


def used(floor: Floor) -> set[int]:
    """Return the numbers of the other layers that a layer imports."""
    number = {name: i for i, other in enumerate(FLOORS) for name in other.names}
    names = {name for path in sources(floor, "py") for name in imported(parsed(path))}
    parts = [name.split(".") for name in names if name.startswith("sigmasplat.")]
    return {number.get(part[1], number["__init__"]) for part in parts} - {FLOORS.index(floor)}


def draw() -> str:
    """Return the picture as SVG: a row for each layer, a dot where its row meets the column of a layer it imports."""
    height = TOP + ROW * len(FLOORS) + 62
    shapes = [
        f'<text class="head" x="{NAME}" y="{TOP - 12}">layer</text>',
        f'<text class="size head" x="{LEFT - 70}" y="{TOP - 12}">files</text>',
        f'<text class="size head" x="{LEFT - 18}" y="{TOP - 12}">lines</text>',
    ]
    for row in range(len(FLOORS) - 1):
        x, y = LEFT + COLUMN * row + COLUMN / 2, TOP + ROW * row + ROW / 2
        shapes.append(f'<line class="guide" x1="{x:g}" x2="{x:g}" y1="{y:g}" y2="{TOP + ROW * len(FLOORS)}"/>')
        shapes.append(f'<line class="guide" x1="{LEFT}" x2="{x + COLUMN:g}" y1="{y + ROW:g}" y2="{y + ROW:g}"/>')
    for row, floor in enumerate(FLOORS):
        shapes += _row(row, floor)
    note = "● the layer of the row imports the layer of the column. No dot lies above the diagonal: imports point up."
    shapes.append(f'<text class="quiet" x="8" y="{height - 12}">{note}</text>')
    size = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">'
    title = "<title>The layers of sigmasplat, and which layer imports which</title>"
    return "\n".join([head, title, f"<style>{STYLE}</style>", *shapes, "</svg>", ""])


def _row(row: int, floor: Floor) -> Iterator[str]:
    """Yield the shapes of one layer: name, contents, sizes, its dots, and its own place on the diagonal."""
    y, files = TOP + ROW * row, sources(floor)
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)
    middle, text = y + ROW / 2, y + ROW / 2 + 4.5
    own = LEFT + COLUMN * row + COLUMN / 2
    if row == 0 or floor.group != FLOORS[row - 1].group:
        yield f'<line class="line" x1="8" x2="{LEFT - 8}" y1="{y}" y2="{y}"/>'
        yield f'<text x="18" y="{text:g}">{escape(floor.group)}</text>'
    yield f'<rect class="{floor.group}" x="8" y="{y + 3}" width="4" height="{ROW - 6}" rx="2"/>'
    yield f'<text class="name" x="{NAME}" y="{text:g}">{escape(floor.label)}</text>'
    what = max(WHAT, NAME + 8 * len(floor.label) + 10)
    yield f'<text class="quiet" x="{what}" y="{text:g}">{escape(floor.what)}</text>'
    yield f'<text class="size" x="{LEFT - 70}" y="{text:g}">{len(files)}</text>'
    yield f'<text class="size" x="{LEFT - 18}" y="{text:g}">{lines}</text>'
    for column in sorted(used(floor)):
        x = LEFT + COLUMN * column + COLUMN / 2
        label = escape(f"{floor.label} imports {FLOORS[column].label}")
        yield f'<circle class="dot" cx="{x:g}" cy="{middle:g}" r="4.5"><title>{label}</title></circle>'
    yield f'<rect class="{floor.group}" x="{own - 7:g}" y="{middle - 7:g}" width="14" height="14" rx="3"/>'
    yield f'<text class="head" x="{own + 12:g}" y="{middle + 4:g}">{escape(floor.label)}</text>'


def without_sizes(picture: str) -> str:
    """Return a picture without the counts of files and lines, which change with every commit."""
    return re.sub(r'<text class="size".*?</text>\n', "", picture)


if __name__ == "__main__":
    PICTURE.write_text(draw(), encoding="utf-8")
