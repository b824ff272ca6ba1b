"""The code of another commit with its compiled kernels, beside this checkout.

Each commit has a folder under build/before/, or under $SIGMASPLAT_BEFORE, with its code (tree/) and what programs keep
of its results.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from io import BytesIO
from pathlib import Path

import record

from sigmasplat.errors import RunError

MODULE = "_core*.so"
IN_PLACE = "-DSIGMASPLAT_INPLACE=ON"
"""With it, older commits compile their kernels into the source tree; later ones do not know it."""
START = """
import os, runpy, sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "Redirecting" not in type(finder).__name__]
import sigmasplat
if not sigmasplat.__file__.startswith(os.environ["PYTHONPATH"]):
    sys.exit(f"{sigmasplat.__file__} is not the code in {os.environ['PYTHONPATH']}")
sys.argv[0] = "sigmasplat"
runpy.run_module("sigmasplat", run_name="__main__")
"""
"""As `python -m sigmasplat`, but never the code of an editable install, which goes before PYTHONPATH."""


def commit_of(revision: str) -> str:
    """Return the full hash of a revision. Raises RunError if this checkout has no such commit."""
    try:
        return _git("rev-parse", "--verify", "--end-of-options", f"{revision}^{{commit}}").decode().strip()
    except RunError as problem:
        raise RunError(f"{record.ROOT} has no commit {revision}: {problem}") from problem


def folder_of(commit: str) -> Path:
    """Return the folder of what is kept of a commit, which may not exist yet; `commit` is a full hash."""
    return Path(os.environ.get("SIGMASPLAT_BEFORE") or record.ROOT / "build" / "before") / commit


def checkout(revision: str) -> Path:
    """Return a tree of a revision's code with compiled kernels; its src/ can be put on PYTHONPATH.

    The tree is kept. The kernels are those of this checkout if they have the same sources and are newer than these;
    otherwise they are compiled, which takes minutes. Raises RunError for an unknown revision, if they do not
    compile, and if the folder cannot be written.
    """
    commit = commit_of(revision)
    tree = folder_of(commit) / "tree"
    if tree.is_dir():
        return tree
    try:
        _make(commit, tree)
    except OSError as problem:
        raise RunError(
            f"cannot write {tree}: {problem.strerror or problem}; choose another folder with SIGMASPLAT_BEFORE"
        ) from problem
    return tree


def _make(commit: str, tree: Path) -> None:
    tree.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="tree-", dir=tree.parent) as temporary:
        made = Path(temporary) / "tree"
        with tarfile.open(fileobj=BytesIO(_git("archive", "--format=tar", commit))) as archive:
            archive.extractall(made, filter="data")
        if not _copy_kernels(commit, made):
            _compile_kernels(made)
        if not tree.is_dir():  # another process may have been faster
            made.rename(tree)


def command() -> list[str]:
    """Return the words that start `sigmasplat` of the tree whose `environment` the process gets."""
    return [sys.executable, "-c", START]


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which `command` runs a tree's code, with one thread and no switch of SigmaSplat set."""
    others = {name: value for name, value in os.environ.items() if not name.startswith("SIGMASPLAT_")}
    return {**others, "PYTHONPATH": str(tree / "src"), "SIGMASPLAT_THREADS": "1", "OMP_NUM_THREADS": "1"}


def built(tree: Path) -> bool:
    """Return whether a tree has compiled kernels that are not older than their sources."""
    modules = [path.stat().st_mtime for path in _modules(tree)]
    sources = [path.stat().st_mtime for end in ("cpp", "h") for path in (tree / "src").rglob(f"*.{end}")]
    return bool(modules) and min(modules) >= max(sources, default=0.0)


def _modules(tree: Path) -> list[Path]:
    return sorted((tree / "src").rglob(MODULE))


def _copy_kernels(commit: str, tree: Path) -> bool:
    """Copy the module of this checkout into a tree of a commit; return False if its sources may be others."""
    if not built(record.ROOT):
        return False
    for module in _modules(record.ROOT):
        folder = module.parent.relative_to(record.ROOT)
        sources = [str(folder), "CMakeLists.txt"]
        different = subprocess.run(["git", "-C", str(record.ROOT), "diff", "--quiet", commit, "--", *sources])
        if different.returncode or not (tree / folder).is_dir():
            return False
        shutil.copy2(module, tree / folder)
    return True


def _compile_kernels(tree: Path) -> None:
    """Compile a tree's kernels in place, as `make native` does. Raises RunError with the last line of the compiler."""
    print(f"compiling the kernels of {tree.parents[1].name[:9]}", file=sys.stderr, flush=True)
    build = tree.parent / "kernels"
    configure = ["-S", str(tree), "-B", str(build), "-G", "Ninja", IN_PLACE]
    configure += [f"-DPython_EXECUTABLE={sys.executable}", f"-DCMAKE_MAKE_PROGRAM={_tool('ninja')}"]
    for words in (configure, ["--build", str(build)]):
        ended = subprocess.run([_tool("cmake"), *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if ended.returncode:
            last = ended.stdout.strip().splitlines()[-1:] or ["no message"]
            raise RunError(f"the kernels of the other commit do not compile: {last[0]}")
    install_kernels(build, tree)


def install_kernels(build: Path, tree: Path) -> None:
    """Copy compiled kernels from a build folder into a source tree. Older commits do this by themselves."""
    for library in build.glob(MODULE):
        shutil.copy(library, tree / "src" / "sigmasplat" / "native")


def _tool(name: str) -> str:
    """Return the path of a build tool, first beside Python. Raises RunError without it."""
    found = shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if found is None:
        raise RunError(f"no {name}, which compiles the kernels of the other commit: pip install cmake ninja nanobind")
    return found


def _git(*words: str) -> bytes:
    """Return the output of a git command in this checkout. Raises RunError with its first line if it fails."""
    try:
        ended = subprocess.run(["git", "-C", str(record.ROOT), *words], capture_output=True)
    except OSError as problem:
        raise RunError(f"git does not start: {problem.strerror}; it reads the other commit") from problem
    if ended.returncode:
        said = ended.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise RunError(f"git {words[0]}: {said[0]}")
    return ended.stdout
