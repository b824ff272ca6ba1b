"""Compile the CUDA kernels' text for a GPU architecture by NVRTC, which needs no driver, and keep the result."""

import hashlib
import io
import os
import re
import tempfile
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from sigmasplat.env import install_extra
from sigmasplat.errors import BackendError

FOLDER = Path(__file__).parent
RASTER, FIT, ALIGN = "raster.cu", "fit.cu", "align.cu"
TEXTS = {
    RASTER: (RASTER, "gradients.cuh", "tiles.cuh", "device.cuh", "sums.cuh", "splat.h"),
    FIT: (FIT, "harmonics.cuh", "track.cuh", "descend.cuh", "sums.cuh"),
    ALIGN: (ALIGN, "align_pixel.h", "align_loop.h", "align_level.h", "sums.cuh"),
}
FEATURE_COUNTS = (4, 7, 11, 16)
"""The feature counts compiled, a program each; a count between them is padded with zeros."""
FITTING = 0
"""In a feature count's place: the program of the fits' loops, which does without one."""
ALIGNING = -1
"""The same for the program that aligns images."""
PROGRAMS = (ALIGNING, FITTING, *FEATURE_COUNTS)
ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
"""What the tests compile for; any other that NVRTC knows is compiled when a device asks for it."""
INSTALL = install_extra("gpu")
INSTALL_OLDER = "pip install 'cuda-bindings<13' nvidia-cuda-nvrtc-cu12"
"""For drivers that know CUDA 12 only."""


class Compiled(NamedTuple):
    """Machine code of one program, and what the compiler had to say about it."""

    code: bytes
    log: str


def cache_folder() -> Path:
    """Return where compiled kernels are kept: the user's cache folder, as the XDG base directories have it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sigmasplat" / "kernels"


def compiler_version() -> str:
    """Say which NVRTC there is. Raises BackendError if there is none."""
    try:
        from cuda.bindings import nvrtc

        _, major, minor = nvrtc.nvrtcVersion()
    except (ImportError, RuntimeError) as problem:
        raise BackendError(f"the CUDA kernels need NVRTC ({problem}): {INSTALL}") from problem
    return f"{major}.{minor}"


def text_of(features: int) -> str:
    """Name the text that a program is made of."""
    return {FITTING: FIT, ALIGNING: ALIGN}.get(features, RASTER)


def cubin(features: int, architecture: str, folder: Path | None = None) -> bytes:
    """Return the program of one feature count as machine code, from the cache where it is there, else compiled.

    folder: instead of the user's cache. A cache that cannot be written is done without. Raises BackendError as
    `compiled` does.
    """
    kept = (folder or cache_folder()) / f"{architecture}-{features}-{key_of(features, architecture)}.cubin"
    try:
        return kept.read_bytes()
    except OSError:
        code = compiled(features, architecture).code
    _keep(kept, code)
    return code


def key_of(features: int, architecture: str) -> str:
    """Hash all that decides on the machine code: texts, options, architecture, the compiler's version."""
    said = [compiler_version(), _core_version(), str(_options(features, architecture))]
    texts = [(FOLDER / name).read_text(encoding="utf-8") for name in TEXTS[text_of(features)]]
    return hashlib.sha256("\0".join(said + texts).encode()).hexdigest()[:32]


def compiled(features: int, architecture: str) -> Compiled:
    """Compile the program. Raises BackendError with the compiler's log, or where NVRTC is missing."""
    compiler_version()
    from cuda.core import Program, ProgramOptions

    log = io.StringIO()
    name = text_of(features)
    options = ProgramOptions(name=name, include_path=str(FOLDER), **_options(features, architecture))
    try:
        program = Program((FOLDER / name).read_text(encoding="utf-8"), "c++", options)
        code = bytes(program.compile("cubin", logs=log).code)
    except Exception as problem:  # cuda-core's own family of errors is private; its text is the compiler's log
        raise BackendError(
            f"the CUDA kernels do not compile for {architecture} with NVRTC {compiler_version()}; try "
            f"{INSTALL}, or report this:\n{problem}"
        ) from problem
    return Compiled(code, log.getvalue())


def _options(features: int, architecture: str) -> dict[str, object]:
    """Return what the compiler is told. Without contraction rounding is what the text says, on every device."""
    return {
        "arch": architecture,
        "std": "c++17",
        "fma": False,
        "device_as_default_execution_space": True,
        "define_macro": [("FEATURES", str(features))],
    }


@cache
def _core_version() -> str:
    return metadata.version("cuda-core")


def architecture_of(capability: tuple[int, int]) -> str:
    """Name the architecture of a compute capability: (9, 0) is sm_90."""
    return f"sm_{capability[0]}{capability[1]}"


def kernel_names(features: int) -> list[str]:
    """List the kernels that a program's texts define, whatever the feature count."""
    texts = ((FOLDER / name).read_text(encoding="utf-8") for name in TEXTS[text_of(features)])
    return [name for text in texts for name in re.findall(r"^KERNEL (\w+)\(", text, re.MULTILINE)]


def _keep(path: Path, code: bytes) -> None:
    """Write machine code to the cache in one step; several processes may do so at once."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as part:
            part.write(code)
        os.replace(part.name, path)
    except OSError:
        return
