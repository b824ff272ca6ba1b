"""Run the CUDA backend's kernels on the CPU: the same text compiled as C++ against emulation/emulation.h."""

import ctypes
import fcntl
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sigmasplat.plugins.cuda import cubins, launch as cuda_launch
from sigmasplat.plugins.cuda.launch import THREADS, Argument, laid_out
from sigmasplat.plugins.cuda.raster import Raster

HERE = Path(__file__).parent / "emulation"
FLAGS = [
    "-std=c++20",
    "-O2",
    "-fPIC",
    "-shared",
    "-U_FORTIFY_SOURCE",
    "-ffp-contract=off",
    "-Wall",
    "-Wextra",
    "-Werror",
]


class Emulator:
    """A `Launcher` for tensors on the CPU; `order` is that of the threads between two barriers (emulation.h)."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.order = folder, 0
        self._libraries: dict[int, ctypes.CDLL] = {}

    def __call__(self, features: int, kernel: str, blocks: int, *arguments: Argument) -> None:
        memory = laid_out(arguments)
        run = self.library(features).emulate
        problem = run(kernel.encode(), blocks, THREADS, ctypes.c_void_p(memory.buffer_info()[0]), self.order)
        assert problem is None, f"{kernel}: {problem.decode()}"

    @contextmanager
    def standing_in(self) -> Iterator[None]:
        """Let the CUDA backend take tensors on the CPU, those of renders begun inside."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cuda_launch, "launcher_for", lambda device: self)
            patch.setattr(cuda_launch, "this_device", lambda: torch.device("cpu"))
            yield

    def library(self, features: int) -> ctypes.CDLL:
        if features not in self._libraries:
            path = self.folder / f"emulated-{features}.so"
            with path.with_suffix(".lock").open("w") as lock:  # workers of pytest-xdist share the folder
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not path.exists():
                    _build(path.with_suffix(".part"), features)
                    path.with_suffix(".part").rename(path)
            library = ctypes.CDLL(str(path))
            library.emulate.restype = ctypes.c_char_p
            self._libraries[features] = library
        return self._libraries[features]


def _build(path: Path, features: int) -> None:
    flags = FLAGS + ["-mfma"] * (platform.machine() == "x86_64")
    includes = [f"-I{folder}" for folder in cubins.include_folders()]
    sources = [f"-DFEATURES={features}", *includes, str(HERE / "kernels.cpp"), "-o", str(path)]
    made = subprocess.run([compiler(), *flags, *sources], capture_output=True, text=True)
    assert made.returncode == 0, made.stderr


def compiler() -> str:
    return os.environ.get("CXX") or "g++"


def why_not() -> str | None:
    """Say why the emulation cannot be built here; None where it can."""
    if shutil.which(compiler()) is None:
        return f"no C++ compiler to emulate CUDA with ({compiler()}); set CXX"
    if platform.system() != "Linux":
        return "CUDA is emulated on Linux only"
    return None


def rubbish(raster: Raster, *size: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Make room as a device might: what nobody writes is not zero."""
    return torch.full(size, torch.nan if dtype.is_floating_point else 99, dtype=dtype)
