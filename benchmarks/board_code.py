"""The code that board.py runs: this checkout, or a commit in a worktree; and its results, kept by the bytes of src."""

import re
import shutil
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import plain
import record
from board_runs import Row, environment
from checkouts import IN_PLACE, install_kernels

from sigmasplat.errors import ConfigError
from sigmasplat.files import machine

MEASURED = ("src", "CMakeLists.txt")
"""What figures of a run depend on."""
KERNELS = "_core*.so"
NOW, BEFORE, PLAIN = "now", "before", "plain"


@dataclass(frozen=True)
class Code:
    """The code of this checkout ("now") or of a commit, or the plain system: equal digests mean equal sources."""

    name: str
    commit: str
    digest: str

    def ready(self, stack: ExitStack, scratch: Path) -> Path | None:
        """Return a checkout of this code whose kernels are compiled; a worktree ends with the stack. None for the plain
        system, which this program runs itself.

        Raises ConfigError if it cannot be made, or if Python would import another package.
        """
        checkout = record.ROOT
        if self.name == PLAIN:
            return None
        if self.name == BEFORE:
            checkout = scratch / "before"
            git("worktree", "add", "--detach", str(checkout), self.commit)
            stack.callback(git, "worktree", "remove", "--force", str(checkout))
            copy_kernels(self.commit, checkout)
        compile_kernels(checkout)
        refuse_other_package(checkout)
        return checkout


def git(*words: str) -> str:
    """Return what a git command prints. Raises ConfigError if it fails."""
    answer = subprocess.run(["git", "-C", str(record.ROOT), *words], capture_output=True, text=True)
    if answer.returncode:
        raise ConfigError(f"git {' '.join(words[:2])}: {(answer.stderr.strip() or 'failed').splitlines()[-1]}")
    return answer.stdout.strip()


def revision(name: str) -> Code:
    """Return the code of a revision. Raises ConfigError if git does not know it."""
    commit = git("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}")
    return Code(BEFORE, commit, digest_of(commit))


def digest_of(commit: str) -> str:
    """Return the digest of the sources of a commit."""
    return sha256(git("rev-parse", *(f"{commit}:{path}" for path in MEASURED)).encode()).hexdigest()[:12]


def plain_system() -> Code:
    """Return the code of plain.py. What it takes from src is not in its digest: it is a fixed peer, and runs once."""
    return Code(PLAIN, git("rev-parse", "HEAD"), PLAIN + sha256(Path(plain.__file__).read_bytes()).hexdigest()[:12])


def current() -> Code:
    """Return the code of this checkout. That of a clean one has the digest of its commit."""
    commit = git("rev-parse", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=all", "--", *MEASURED)
    digest = f"changed{record.code_digest(record.ROOT / 'src')}" if changed else digest_of(commit)
    return Code(NOW, commit, digest)


# ---- a checkout that runs ----


def kernels_of(checkout: Path) -> Path | None:
    """Return the compiled kernels of a checkout; None if they are missing or older than their sources."""
    for library in (checkout / "src").rglob(KERNELS):
        sources = [path for path in library.parent.rglob("*") if path.suffix in (".h", ".cpp")]
        if all(path.stat().st_mtime <= library.stat().st_mtime for path in sources):
            return library
    return None


def copy_kernels(commit: str, checkout: Path) -> None:
    """Copy this checkout's kernels into that of a commit, if they are compiled from the same files there."""
    library = kernels_of(record.ROOT)
    if library is None:
        return
    folder = library.parent.relative_to(record.ROOT)
    if (checkout / folder).is_dir() and not git("diff", "--name-only", commit, "--", str(folder), "CMakeLists.txt"):
        shutil.copy(library, checkout / folder)  # its time is now: later than that of the sources


def compile_kernels(checkout: Path) -> None:
    """Compile the kernels into the source tree, as `make native` does, unless they are there. Raises ConfigError."""
    if kernels_of(checkout):
        return
    print(f"compiling the kernels of {checkout}", file=sys.stderr, flush=True)
    build = str(checkout / "build" / "inplace")
    configure = ["cmake", "-S", str(checkout), "-B", build, "-G", "Ninja", IN_PLACE]
    for words in ([*configure, f"-DPython_EXECUTABLE={sys.executable}"], ["cmake", "--build", build, "-j", "2"]):
        ended = subprocess.run(words, env=environment(checkout), capture_output=True, text=True)
        if ended.returncode:
            raise ConfigError(f"the kernels cannot be compiled: {(ended.stderr or ended.stdout).strip()[-300:]}")
    install_kernels(Path(build), checkout)


def refuse_other_package(checkout: Path) -> None:
    """Raise ConfigError if Python does not import the package of a checkout, as an editable install may cause."""
    words = [sys.executable, "-c", "import sigmasplat; print(sigmasplat.__file__)"]
    answer = subprocess.run(words, env=environment(checkout), capture_output=True, text=True)
    imported = answer.stdout.strip()
    if answer.returncode or not Path(imported).is_relative_to(checkout / "src"):
        found = imported or answer.stderr.strip()[-200:]
        raise ConfigError(f"Python does not import the package in {checkout / 'src'} but {found}")


# ---- its results ----


@dataclass
class Kept:
    """The results of one code on this machine, by row and seed; every new one is written to its file."""

    path: Path
    code: Code
    results: dict[str, dict[str, Any]] = field(default_factory=dict)

    @staticmethod
    def of(code: Code, folder: Path) -> "Kept":
        """Read the results of a code, also those that another commit with the same sources has."""
        made_on = record.machine_slug(machine.describe())
        own = folder / f"{code.commit[:12]}-{code.digest}-{made_on}.json"
        pattern = re.compile(rf"[0-9a-f]{{12}}-{re.escape(code.digest)}-{re.escape(made_on)}\.json")
        files = [path for path in sorted(folder.glob("*.json")) if pattern.fullmatch(path.name)]
        results: dict[str, dict[str, Any]] = {}
        for path in files:
            results |= record.read(path)["results"]
        return Kept(own, code, results)

    def found(self, row: Row, seed: int) -> dict[str, Any] | None:
        """Return the result of a row; None if it is not there or has failed."""
        result = self.results.get(row.key(seed))
        return result if result and result["problem"] is None else None

    def keep(self, row: Row, seed: int, result: dict[str, Any]) -> None:
        """Add a result and write the file."""
        self.results[row.key(seed)] = result
        self.path.parent.mkdir(parents=True, exist_ok=True)
        record.write_json({"code": asdict(self.code), "results": self.results}, self.path)
