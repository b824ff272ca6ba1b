"""Hold the house to its floor plan (docs/architecture.md): read the sources, run nothing."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "sigmasplat"
FLOORS = [
    ["errors", "env", "types", "config", "presets"],
    ["native"],
    ["model"],
    ["render"],
    ["fit"],
    ["slam"],
    ["sources"],
    ["io"],
    ["metrics"],
    [
        "evaluate",
        "profile",
        "session",
        "protocols",
        "screen",
        "doctor",
        "surface",
        "exports",
        "ablation",
        "inspection",
        "apart",
        "gallery",
        "page",
        "snapshots",
        "download",
        "viewer",
        "commands",
        "cli",
        "__init__",
        "__main__",
    ],
]
STOREY = {name: storey for storey, names in enumerate(FLOORS) for name in names}
# Sources, results and scores know nothing of how SLAM decides, though they stand below it.
FORBIDDEN = {(user, "slam") for user in ("sources", "io", "metrics")} | {("metrics", "io"), ("metrics", "sources")}
SYSTEM_NAMES = re.compile("varsplat|cg[-_ ]?slam|loopsplat", re.IGNORECASE)
PRESET_NAMES = re.compile("varsplat|cg_?slam|loopsplat")
GPL = {"evo", "plyfile"}
NAMELESS = {"utils", "util", "helpers", "helper", "common", "misc"}
FILES = sorted(PACKAGE.rglob("*.py"))
TEXTS = sorted(file for ending in ("py", "pyi", "h", "cpp", "cu") for file in PACKAGE.rglob(f"*.{ending}"))
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))


def floor_of(path: Path) -> str:
    """Name the floor a file stands on: its folder, or its own name at the top."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield every module (or name in one) imported anywhere in a file, dotted; TYPE_CHECKING blocks count too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute, so that the floors can be read"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def used_floors(tree: ast.AST) -> set[str]:
    names = (name.split(".") for name in imported(tree))
    return {parts[1] if parts[1] in STOREY else "__init__" for parts in names if parts[0] == "sigmasplat" and parts[1:]}


def problems_of_floors(user: str, tree: ast.AST) -> list[str]:
    """Say which imports of a file on floor `user` lead downwards or to a floor it must not know."""
    others = used_floors(tree) - {user}
    downwards = [f"{user} imports {other}, a floor below" for other in others if STOREY[other] > STOREY[user]]
    return downwards + [f"{user} must not know {other}" for other in others if (user, other) in FORBIDDEN]


def words_in_code(tree: ast.AST) -> Iterator[str]:
    """Yield identifiers and strings of a file; bare string statements are documentation and left out."""
    documentation = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documentation:
            yield node.value
        for field in ("id", "name", "attr", "arg", "asname", "module"):
            word = getattr(node, field, None)
            if isinstance(word, str):
                yield word


def reads_truth(tree: ast.AST) -> bool:
    return any(
        isinstance(node, ast.Attribute) and node.attr in {"truth", "true_surface"} and isinstance(node.ctx, ast.Load)
        for node in ast.walk(tree)
    )


def parsed(path: Path) -> ast.AST:
    return ast.parse(path.read_text(encoding="utf-8"))


@each_file
def test_a_floor_imports_only_from_above(path: Path) -> None:
    assert floor_of(path) in STOREY, f"{path} stands on no floor: give it one in docs/architecture.md and here"
    assert problems_of_floors(floor_of(path), parsed(path)) == []


@each_file
def test_only_evaluation_reads_ground_truth(path: Path) -> None:
    if floor_of(path) not in {"sources", "evaluate"}:
        assert not reads_truth(parsed(path))


@each_file
def test_systems_are_named_in_presets_only(path: Path) -> None:
    if floor_of(path) != "presets":
        assert [word for word in words_in_code(parsed(path)) if SYSTEM_NAMES.search(word)] == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_text_but_presets_spells_a_system_as_code_would(path: Path) -> None:
    """Citations are written as the papers write their names; in lower case a name is a preset, or about to decide."""
    if floor_of(path) != "presets":
        assert PRESET_NAMES.findall(path.read_text(encoding="utf-8")) == []


@each_file
def test_every_module_has_a_name_and_a_licence_we_can_use(path: Path) -> None:
    assert not NAMELESS & {part.removesuffix(".py") for part in path.relative_to(PACKAGE).parts}
    assert not GPL & {name.split(".")[0] for name in imported(parsed(path))}


@each_file
def test_files_and_functions_stay_readable(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 250
    functions = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    assert [f.name for f in functions if (f.end_lineno or f.lineno) - f.lineno + 1 > 60] == []


def test_the_checks_notice_what_they_are_for() -> None:
    assert problems_of_floors("model", ast.parse("def f():\n    from sigmasplat.slam.slam import Slam"))
    assert problems_of_floors("model", ast.parse("from sigmasplat import render"))
    assert problems_of_floors("metrics", ast.parse("import sigmasplat.slam.slam"))
    assert problems_of_floors("slam", ast.parse("from sigmasplat import open_source"))
    assert not problems_of_floors("slam", ast.parse("from sigmasplat.fit.pose import fit_pose\nimport torch"))
    assert reads_truth(ast.parse("path = source.truth()")) and reads_truth(ast.parse("source.true_surface()"))
    documented = ast.parse('"""VarSplat eq. 3"""\nx = 1  # LoopSplat\n')
    assert not [word for word in words_in_code(documented) if SYSTEM_NAMES.search(word)]
    for code in ("if name == 'CG-SLAM': pass", "varsplat_loss = 1", "def f(x, loopsplat=1): pass", "f(cgslam=1)"):
        assert [word for word in words_in_code(ast.parse(code)) if SYSTEM_NAMES.search(word)], code


def test_the_sources_were_found() -> None:
    assert {"model", "config", "presets", "__init__"} <= {floor_of(path) for path in FILES}
    assert {".py", ".pyi", ".h", ".cpp"} <= {path.suffix for path in TEXTS}
    assert PRESET_NAMES.search('if (name == "cgslam")') and not PRESET_NAMES.search("// (CG-SLAM eq. 10, VarSplat §3)")
