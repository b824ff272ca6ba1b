"""benchmarks/checkouts.py: the code of the named commit runs, with kernels of its own sources."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sigmasplat.errors import RunError

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
checkouts, record = map(importlib.import_module, ("checkouts", "record"))

NATIVE = Path("src/sigmasplat/native")
SPY = """
import sys
class RedirectingFinder:
    def find_spec(self, name, path=None, target=None):
        if name == "sigmasplat":
            raise ImportError("the code of an editable install")
sys.meta_path.insert(0, RedirectingFinder())
"""


def git(folder: Path, *words: str) -> None:
    named = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(folder), *named, *words], check=True, capture_output=True)


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a repository with one commit, tagged first, and kernels that are "compiled" from its sources."""
    root = tmp_path / "checkout"
    native = root / NATIVE
    native.mkdir(parents=True)
    (root / ".gitignore").write_text("*.so\nbuild/\n")
    (root / "CMakeLists.txt").write_text("project(a)\n")
    (root / "src/sigmasplat/__init__.py").touch()
    (root / "src/sigmasplat/__main__.py").write_text("import sys; print('first', *sys.argv)\n")
    (native / "a.cpp").write_text("int a;\n")
    (native / "_core.so").write_text("compiled")
    git(root, "init")
    git(root, "add", ".")
    git(root, "commit", "-m", "first")
    git(root, "tag", "first")
    monkeypatch.setattr(record, "ROOT", root)
    monkeypatch.delenv("SIGMASPLAT_BEFORE", raising=False)

    def compiled(tree: Path) -> None:
        (tree / NATIVE / "_core.so").write_text("compiled again")

    monkeypatch.setattr(checkouts, "_compile_kernels", compiled)
    return root


def module(tree: Path) -> str:
    return (tree / NATIVE / "_core.so").read_text()


def test_a_checkout_has_the_code_of_its_commit_and_is_kept(repository: Path) -> None:
    main = repository / "src/sigmasplat/__main__.py"
    main.write_text("print('second')\n")
    tree = checkouts.checkout("first")
    assert tree == repository / "build" / "before" / checkouts.commit_of("first") / "tree"
    assert "first" in (tree / "src/sigmasplat/__main__.py").read_text() and module(tree) == "compiled"
    (tree / "kept").touch()
    assert checkouts.checkout(checkouts.commit_of("first")) == tree and (tree / "kept").is_file()
    assert [path.name for path in tree.parent.iterdir()] == ["tree"]


def test_the_folder_of_checkouts_can_be_chosen(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIGMASPLAT_BEFORE", str(tmp_path / "elsewhere"))
    assert tmp_path / "elsewhere" in checkouts.checkout("first").parents


def test_kernels_are_compiled_if_their_sources_differ(repository: Path) -> None:
    (repository / NATIVE / "a.cpp").write_text("int b;\n")
    later = (repository / NATIVE / "a.cpp").stat().st_mtime + 10
    os.utime(repository / NATIVE / "_core.so", (later, later))
    assert checkouts.built(repository) and module(checkouts.checkout("first")) == "compiled again"


def test_kernels_older_than_their_sources_are_not_used(repository: Path) -> None:
    os.utime(repository / NATIVE / "_core.so", (0, 0))
    assert not checkouts.built(repository) and module(checkouts.checkout("first")) == "compiled again"


def test_nothing_is_left_of_a_checkout_whose_kernels_do_not_compile(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(tree: Path) -> None:
        raise RunError("no compiler")

    monkeypatch.setattr(checkouts, "_compile_kernels", fails)
    (repository / NATIVE / "_core.so").unlink()
    with pytest.raises(RunError, match="no compiler"):
        checkouts.checkout("first")
    assert not list(checkouts.folder_of(checkouts.commit_of("first")).iterdir())


@pytest.mark.parametrize("revision", ["nonsense", "--all", ""])
def test_an_unknown_revision_is_refused_in_one_line(repository: Path, revision: str) -> None:
    with pytest.raises(RunError, match="has no commit") as refused:
        checkouts.checkout(revision)
    assert "\n" not in str(refused.value)


def ran(tree: Path, path: Path) -> subprocess.CompletedProcess[str]:
    environment = {**checkouts.environment(tree), "PYTHONPATH": str(path)}
    return subprocess.run([*checkouts.command(), "run", "x"], env=environment, capture_output=True, text=True)


def test_the_command_runs_the_code_of_the_tree_and_not_that_of_an_editable_install(repository: Path) -> None:
    (repository / "src" / "sitecustomize.py").write_text(SPY)
    assert ran(repository, repository / "src").stdout == "first sigmasplat run x\n"
    assert checkouts.environment(repository)["PYTHONPATH"] == str(repository / "src")


def test_switches_of_the_callers_environment_do_not_change_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SIGMASPLAT_ISA", "baseline")
    monkeypatch.setenv("SIGMASPLAT_THREADS", "2")
    found = checkouts.environment(Path("a"))
    assert "SIGMASPLAT_ISA" not in found and found["SIGMASPLAT_THREADS"] == found["OMP_NUM_THREADS"] == "1"


def test_a_folder_that_cannot_be_written_is_refused(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SIGMASPLAT_BEFORE", str(tmp_path / "file"))
    with pytest.raises(RunError, match=r"cannot write .*SIGMASPLAT_BEFORE"):
        checkouts.checkout("first")


def test_the_command_never_runs_other_code(repository: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    ended = subprocess.run(
        [*checkouts.command(), "run"], cwd=repository / "src", capture_output=True, text=True,
        env={**checkouts.environment(repository), "PYTHONPATH": str(tmp_path / "empty")},
    )  # fmt: skip
    assert ended.returncode == 1 and "is not the code in" in ended.stderr and not ended.stdout
