"""Read the environment variables, once; folders that commands share. Import this before anything that loads OpenMP.

| variable | values | meaning |
|---|---|---|
| SIGMASPLAT_THREADS | whole number ≥ 0 | number of threads of the kernels and of torch; 0 or unset = all cores |
| SIGMASPLAT_ISA | auto, avx512, avx2, baseline | instruction set of the CPU kernels; auto = the widest supported one |
| SIGMASPLAT_BACKEND | auto, cpu, cuda, reference, or a plug-in | renderer if the setting `backend` is auto |
| SIGMASPLAT_PLUGINS | files, separated by colons | plug-ins of yours, the same as --plugin (`registry`) |
"""

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast, get_args

from sigmasplat.errors import ConfigError, SourceError

Isa = Literal["auto", "avx512", "avx2", "baseline"]

# libgomp reads this when it is loaded. Idle threads then sleep instead of spinning: 5× faster on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

LPIPS_FOLDER = Path("data/lpips")
"""Where `sigmasplat download lpips` puts the weights."""


@dataclass(frozen=True)
class Switches:
    """The values of the environment variables."""

    threads: int = 0
    """0 = all cores."""
    isa: Isa = "auto"
    backend: str = "auto"


@cache
def switches() -> Switches:
    """Return the switches of this process, read at the first call. Raises ConfigError on an invalid value."""
    return read(os.environ)


def read(environment: Mapping[str, str]) -> Switches:
    """Read the switches from a mapping such as `os.environ`; unset or empty means the default. Raises ConfigError."""
    threads, isa, backend = (
        environment.get(f"SIGMASPLAT_{name}", "").strip() for name in ("THREADS", "ISA", "BACKEND")
    )
    if threads and not (threads.isascii() and threads.isdecimal()):
        raise ConfigError(f"SIGMASPLAT_THREADS is {threads!r}; give a whole number of threads, 0 for all cores")
    isa = isa.lower() or "auto"
    if isa not in get_args(Isa):
        raise ConfigError(f"SIGMASPLAT_ISA is {isa!r}; give one of {', '.join(get_args(Isa))}")
    return Switches(int(threads or 0), cast(Isa, isa), backend.lower() or "auto")


def install_package(requirement: str) -> str:
    """Return the command that installs a package into the running Python."""
    return f"{sys.executable} -m pip install {requirement}"


def install_extra(extra: str) -> str:
    """Return the command that installs an optional dependency into the running Python."""
    return install_package(f"'sigmasplat[{extra}]'")


def import_optional(module: str, extra: str, what: str) -> Any:
    """Import a module. Raises SourceError naming what needs it and the extra that installs it."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise SourceError(f"{what} needs {module} ({error}): {install_extra(extra)}") from error
    except ImportError as error:
        raise SourceError(
            f"{what} needs {module}, which is installed but does not load ({error}); install the missing system library"
        ) from error


@cache
def opencv() -> Any:
    """Return the module cv2; it uses SIGMASPLAT_THREADS threads. Raises ConfigError if it cannot be imported."""
    try:
        cv2 = import_module("cv2")
    except ImportError as problem:
        raise ConfigError(
            f"features and stereo pairs need OpenCV, which does not load ({problem}): "
            f"{install_package('opencv-python-headless')}"
        ) from problem
    if switches().threads:
        cv2.setNumThreads(switches().threads)
    return cv2
