"""Compile the CUDA kernels for a GPU architecture with NVRTC, which needs no driver, and cache the result."""

import hashlib
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sigmasplat.api import BackendError, install_extra

FOLDER = Path(__file__).parents[2] / "native"
"""Folder of the sources: headers shared with the CPU kernels, and the CUDA kernels in its subfolder `cuda`."""
RASTER, FIT, ALIGN = "cuda/raster.cu", "cuda/fit.cu", "cuda/align.cu"
TEXTS = {
    RASTER: (RASTER, "cuda/gradients.cuh", "cuda/tiles.cuh", "cuda/device.cuh", "cuda/sums.cuh", "splat.h"),
    FIT: (FIT, "cuda/harmonics.cuh", "cuda/track.cuh", "cuda/descend.cuh", "cuda/sums.cuh", "harmonics.h"),
    ALIGN: (ALIGN, "align_pixel.h", "late_points.h", "align_loop.h", "align_level.h", "cuda/sums.cuh"),
}
FEATURE_COUNTS = (4, 7, 11, 16)
"""The compiled feature counts, one program each; other counts are padded with zeros."""
FITTING = 0
"""Used instead of a feature count for the program of the fits' loops, which has no feature count."""
ALIGNING = -1
"""The same for the program that aligns images."""
RAYS = (-4, -7)
"""The same for the programs of views with `render.depth=ray`: their feature counts, negative."""
PROGRAMS = (ALIGNING, FITTING, *FEATURE_COUNTS, *RAYS)
INSTALL = install_extra("cuda")
INSTALL_OLDER = "pip install 'cuda-bindings<13' nvidia-cuda-nvrtc-cu12"
"""For drivers that support only CUDA 12."""


class Compiled(NamedTuple):
    """Machine code of one program, or PTX, and the compiler's log."""

    code: bytes
    log: str


def cache_folder() -> Path:
    """Return the folder of compiled kernels: the user's cache folder of the XDG standard."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sigmasplat" / "kernels"


def compiler_version() -> str:
    """Return the version of NVRTC. Raises BackendError if it is not installed."""
    try:
        from cuda.bindings import nvrtc

        _, major, minor = nvrtc.nvrtcVersion()
    except (ImportError, RuntimeError) as problem:
        raise BackendError(f"the CUDA kernels need NVRTC ({problem}): {INSTALL}") from problem
    return f"{major}.{minor}"


def text_of(features: int) -> str:
    """Return the name of the source file of a program."""
    return {FITTING: FIT, ALIGNING: ALIGN}.get(features, RASTER)


def cubin(features: int, architecture: str, folder: Path | None = None) -> bytes:
    """Return the machine code of the program of one feature count, from the cache if it is there, else compiled.

    folder: replaces the user's cache. If a cache cannot be written, it is not used. Raises BackendError as `compiled`
    does.
    """
    kept = (folder or cache_folder()) / f"{architecture}-{features}-{key_of(features, architecture)}.cubin"
    try:
        return kept.read_bytes()
    except OSError:
        code = compiled(features, architecture).code
    _keep(kept, code)
    return code


def key_of(features: int, architecture: str) -> str:
    """Return a hash of everything that determines the machine code: sources, options, architecture, compiler
    version."""
    said = [compiler_version(), *_options(features, architecture)]
    texts = [(FOLDER / name).read_text(encoding="utf-8") for name in TEXTS[text_of(features)]]
    return hashlib.sha256("\0".join(said + texts).encode()).hexdigest()[:32]


def compiled(features: int, architecture: str, more: Sequence[str] = ()) -> Compiled:
    """Compile the program: machine code for sm_90, PTX for compute_90.

    more: further options of NVRTC. Raises BackendError with the compiler's log, or if NVRTC is missing.
    """
    version = compiler_version()
    from cuda.bindings import nvrtc

    name = text_of(features)
    options = [*_options(features, architecture), *(f"--include-path={folder}" for folder in include_folders()), *more]
    _, program = nvrtc.nvrtcCreateProgram((FOLDER / name).read_bytes(), name.encode(), 0, [], [])
    try:
        (result,) = nvrtc.nvrtcCompileProgram(program, len(options), [option.encode() for option in options])
        log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program).decode(errors="replace")
        if result != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            raise BackendError(
                f"the CUDA kernels do not compile for {architecture} with NVRTC {version}; try {INSTALL}, or report "
                f"this:\n{result.name}\n{_said(log)}"
            )
        kind = "CUBIN" if architecture.startswith("sm_") else "PTX"
        code = _read(getattr(nvrtc, f"nvrtcGet{kind}Size"), getattr(nvrtc, f"nvrtcGet{kind}"), program)
    finally:
        nvrtc.nvrtcDestroyProgram(program)
    return Compiled(code, _said(log))


def _read(size_of: Callable[..., Any], fill: Callable[..., Any], program: Any) -> bytes:
    """Copy one result of a program from NVRTC."""
    memory = bytearray(size_of(program)[1])
    fill(program, memory)
    return bytes(memory)


def _said(log: str) -> str:
    return log.rstrip("\0").strip()


def _options(features: int, architecture: str) -> list[str]:
    """Return the compiler's options. Contraction is off, so that the rounding is the same on every device."""
    return [
        f"--gpu-architecture={architecture}",
        "--std=c++17",
        "--fmad=false",
        "--device-as-default-execution-space",
        f"--define-macro=FEATURES={features}",
    ]


def architecture_of(capability: tuple[int, int]) -> str:
    """Return the name of the architecture of a compute capability: (9, 0) is sm_90."""
    return f"sm_{capability[0]}{capability[1]}"


def target_of(capability: tuple[int, int]) -> str:
    """Return the architecture to compile for on a device, or compute_120 if the compiler is older than the device.

    compute_120 means PTX of the newest architecture that the compiler knows; the driver converts it to machine code.
    Raises BackendError without NVRTC.
    """
    compiler_version()
    from cuda.bindings import nvrtc

    number, known = 10 * capability[0] + capability[1], sorted(nvrtc.nvrtcGetSupportedArchs()[1])
    older = [other for other in known if other < number]
    return f"compute_{older[-1]}" if number not in known and older else architecture_of(capability)


def include_folders() -> tuple[Path, ...]:
    """Return the folder of the sources' headers."""
    return FOLDER / "cuda", FOLDER


def _keep(path: Path, code: bytes) -> None:
    """Write machine code to the cache atomically, because several processes may do so at once."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as part:
            part.write(code)
        os.replace(part.name, path)
    except OSError:
        return
