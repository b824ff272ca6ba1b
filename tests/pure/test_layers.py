"""Hold the house to its floor plan (docs/architecture.md): read the sources, run nothing."""

import ast
import importlib
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import scipy.sparse

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "sigmasplat"
sys.path.append(str(ROOT / "docs" / "theme"))
floors = importlib.import_module("floors")
imported = floors.imported
FLOORS = [list(floor.names) for floor in floors.FLOORS]
FLOOR = {name: number for number, names in enumerate(FLOORS) for name in names}
# Plug-ins that read or show a run do not know how SLAM decides, though they come after it in the list.
BLIND = (
    "plugins/evaluation/metrics",
    "plugins/evaluation/report",
    "plugins/evaluation/view_scores.py",
    "plugins/outputs/drawing",
    "plugins/outputs/floorplan",
    "plugins/outputs/mesh_files.py",
    "plugins/outputs/mesh_editing.py",
    "plugins/sources",
    "plugins/checks",
    "run_folder",
    "input",
)
DECIDING = {"tracking", "mapping", "graph", "slam", "final", "system", "realtime"}
PRESETS = ("plugins/presets", "config/find_preset.py")
SYSTEM_NAMES = re.compile("varsplat|cg[-_ ]?slam|loopsplat", re.IGNORECASE)
PRESET_NAMES = re.compile("varsplat|cg_?slam|loopsplat")
GPL = {"evo", "plyfile"}
NAMELESS = {"utils", "util", "helpers", "helper", "common", "misc"}
MOST_LINES_OF_A_FILE, MOST_LINES_OF_A_FUNCTION = 350, 60
FILES = sorted(PACKAGE.rglob("*.py"))
TEXTS = sorted(file for ending in ("py", "pyi", "h", "cpp", "cu") for file in PACKAGE.rglob(f"*.{ending}"))


def floor_of(path: Path) -> str:
    """Name the floor a file stands on: its folder, or its own name at the top."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def used_floors(tree: ast.AST) -> set[str]:
    names = (name.split(".") for name in imported(tree))
    return {parts[1] if parts[1] in FLOOR else "__init__" for parts in names if parts[0] == "sigmasplat" and parts[1:]}


def problems_of_floors(user: str, tree: ast.AST) -> list[str]:
    """List the imports of a file on floor `user` that lead to a lower floor, or to a floor it must not know."""
    others = used_floors(tree) - {user}
    return [f"{user} imports {other}, a floor below" for other in others if FLOOR[other] > FLOOR[user]]


def below(path: Path, folders: tuple[str, ...]) -> bool:
    """Tell whether a file is in one of some folders of the package, or is one of some files."""
    return path.relative_to(PACKAGE).as_posix().startswith(folders)


def module_of(path: Path) -> str:
    parts = ("sigmasplat", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts).removesuffix(".__init__")


def circles(imports: Mapping[str, set[str]]) -> list[list[str]]:
    """Return groups of modules that import one another, directly or through others."""
    names = sorted(imports)
    number = {name: i for i, name in enumerate(names)}
    pairs = [(number[user], number[used]) for user in names for used in imports[user]]
    rows, columns = zip(*pairs, strict=True) if pairs else ((), ())
    matrix = scipy.sparse.coo_array((np.ones(len(pairs)), (rows, columns)), (len(names), len(names)))
    count, labels = scipy.sparse.csgraph.connected_components(matrix, directed=True, connection="strong")
    groups = [[name for name in names if labels[number[name]] == label] for label in range(count)]
    return [group for group in groups if len(group) > 1]


def imports_of_modules() -> dict[str, set[str]]:
    """Return the modules of the package that each module imports, at the top or inside a function."""
    modules = {module_of(path): path for path in FILES}
    found = dict[str, set[str]]()
    for user, path in modules.items():
        names = set(imported(parsed(path)))
        used = {name if name in modules else name.rpartition(".")[0] for name in names}
        found[user] = (used & modules.keys()) - {user}
    return found


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
        isinstance(node, ast.Attribute)
        and node.attr in {"truth", "true_surface", "true_surface_file"}
        and isinstance(node.ctx, ast.Load)
        for node in ast.walk(tree)
    )


def parsed(path: Path) -> ast.AST:
    tree: ast.AST = floors.parsed(path)
    return tree


def test_a_floor_imports_only_from_above() -> None:
    homeless = [str(path) for path in FILES if floor_of(path) not in FLOOR]
    assert not homeless, "give these a floor in docs/theme/floors.py"
    found = {str(path.relative_to(PACKAGE)): problems_of_floors(floor_of(path), parsed(path)) for path in FILES}
    assert {path: problems for path, problems in found.items() if problems} == {}


def test_readers_of_runs_do_not_know_how_slam_decides() -> None:
    found = {str(path): used_floors(parsed(path)) & DECIDING for path in FILES if below(path, BLIND)}
    assert len(found) > 60 and {path: names for path, names in found.items() if names} == {}


def test_plugins_import_the_api_and_each_other_only() -> None:
    files = [path for path in FILES if below(path, ("plugins",))]
    found = dict[str, list[str]]()
    for path in files:
        modules = (node.module or "" for node in ast.walk(parsed(path)) if isinstance(node, ast.ImportFrom))
        names = (module for module in modules if module.startswith("sigmasplat"))
        found[str(path)] = [name for name in names if not name.startswith(("sigmasplat.api", "sigmasplat.plugins"))]
    assert len(found) > 100 and {path: names for path, names in found.items() if names} == {}


def test_the_picture_of_the_floors_shows_the_current_imports() -> None:
    committed = floors.PICTURE.read_text(encoding="utf-8")
    same = floors.without_sizes(committed) == floors.without_sizes(floors.draw())
    assert same, "run python docs/theme/floors.py"
    assert "<title>slam imports fit</title>" in committed and "<title>fit imports slam</title>" not in committed


def test_no_modules_import_each_other() -> None:
    assert circles(imports_of_modules()) == []


def test_few_files_lie_loose_on_top() -> None:
    assert len(sorted(PACKAGE.glob("*.py"))) <= 8


def test_only_evaluation_reads_ground_truth() -> None:
    others = [path for path in FILES if not below(path, ("input", "plugins/sources", "plugins/evaluation"))]
    assert [str(path) for path in others if reads_truth(parsed(path))] == []


def test_systems_are_named_in_presets_only() -> None:
    """Citations are written as the papers write their names; in lower case a name is a preset, or about to decide."""
    words = {
        str(path): [word for word in words_in_code(parsed(path)) if SYSTEM_NAMES.search(word)]
        for path in FILES
        if not below(path, PRESETS)
    }
    assert {path: found for path, found in words.items() if found} == {}
    texts = [path for path in TEXTS if not below(path, PRESETS)]
    assert [str(path) for path in texts if PRESET_NAMES.search(path.read_text(encoding="utf-8"))] == []


def test_every_module_has_a_name_and_a_licence_we_can_use() -> None:
    parts = {str(path): {part.removesuffix(".py") for part in path.relative_to(PACKAGE).parts} for path in FILES}
    assert [path for path, names in parts.items() if NAMELESS & names] == []
    assert [path for path in FILES if GPL & {name.split(".")[0] for name in imported(parsed(path))}] == []


def test_files_and_functions_stay_readable() -> None:
    long = dict[str, int]()
    for path in FILES:
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > MOST_LINES_OF_A_FILE:
            long[str(path)] = lines
        functions = (n for n in ast.walk(parsed(path)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
        for function in functions:
            if (lines := (function.end_lineno or 0) - function.lineno + 1) > MOST_LINES_OF_A_FUNCTION:
                long[f"{path}: {function.name}"] = lines
    assert long == {}


def test_the_checks_notice_what_they_are_for() -> None:
    assert problems_of_floors("slam", ast.parse("from sigmasplat.final.final_map import final_map"))
    assert problems_of_floors("data", ast.parse("def f():\n    from sigmasplat.system.slam import Slam"))
    assert problems_of_floors("data", ast.parse("from sigmasplat import render"))
    assert problems_of_floors("run", ast.parse("import sigmasplat.plugins.viewer.app"))
    assert problems_of_floors("slam", ast.parse("from sigmasplat import open_source"))
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]] and not circles({"a": set()})
    assert problems_of_floors("slam", ast.parse("from sigmasplat.api import open_source"))
    assert not problems_of_floors("slam", ast.parse("from sigmasplat.fit.pose import fit_pose\nimport torch"))
    assert reads_truth(ast.parse("path = source.truth()")) and reads_truth(ast.parse("source.true_surface()"))
    documented = ast.parse('"""VarSplat eq. 3"""\nx = 1  # LoopSplat\n')
    assert not [word for word in words_in_code(documented) if SYSTEM_NAMES.search(word)]
    for code in ("if name == 'CG-SLAM': pass", "varsplat_loss = 1", "def f(x, loopsplat=1): pass", "f(cgslam=1)"):
        assert [word for word in words_in_code(ast.parse(code)) if SYSTEM_NAMES.search(word)], code


def test_the_sources_were_found() -> None:
    assert {"data", "config", "plugins", "__init__"} <= {floor_of(path) for path in FILES}
    assert {".py", ".pyi", ".h", ".cpp"} <= {path.suffix for path in TEXTS}
    assert PRESET_NAMES.search('if (name == "cgslam")') and not PRESET_NAMES.search("// (CG-SLAM eq. 10, VarSplat §3)")
