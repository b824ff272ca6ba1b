"""Compile native/splat.h in double precision, and call it."""

import ctypes
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulated_cuda import HERE, compiler, why_not
from sigmasplat.plugins.cuda import cubins

Array = NDArray[np.float64]


@cache
def _compiled() -> Any:
    if reason := why_not():
        pytest.skip(reason)
    with TemporaryDirectory() as folder:
        library = Path(folder) / "in_double.so"
        includes = [f"-I{path}" for path in cubins.include_folders()]
        words = [compiler(), "-std=c++20", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror", *includes]
        made = subprocess.run([*words, str(HERE / "in_double.cpp"), "-o", str(library)], capture_output=True, text=True)
        assert made.returncode == 0, made.stderr
        return ctypes.CDLL(str(library)).project_double


def project_double(view: Array, means: Array, quats: Array, scales: Array, g: Array) -> tuple[Array, Array]:
    """Return the footprints (u, v, z, conic, slopes) [N, 8] of N splats, and gradients [N, 16] given those g [N, 8]."""
    footprint, gradient = np.empty((len(means), 8)), np.empty((len(means), 16))
    arrays = (np.ascontiguousarray(array, np.float64) for array in (view, means, quats, scales, g))
    kept = [*arrays, footprint, gradient]
    _compiled()(len(means), *(ctypes.c_void_p(array.ctypes.data) for array in kept))
    return footprint, gradient
