"""Compile every CUDA kernel for every architecture, as a device would at first use; no GPU is needed."""

import importlib
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from cuda_kernels import ARCHITECTURES, kernel_names
from sigmasplat.errors import BackendError
from sigmasplat.plugins.cuda import cubins

pytest.importorskip("cuda.bindings.nvrtc", reason="cuda-bindings is not installed: pip install 'sigmasplat[cuda]'")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))
kernels = importlib.import_module("kernels")

MOST_SPILLED = {-4: 20, 11: 16, 16: 24, cubins.ALIGNING: 96}
"""Bytes of a thread, by program: what ptxas gives away from sm_90 on to hold one more block on a multiprocessor, and,
where alignment solves for a step, to the one thread that does, and to where the row of a pixel was read."""


@pytest.mark.parametrize(
    "architecture",
    [pytest.param(each, marks=() if each == "sm_90" else pytest.mark.slow) for each in ARCHITECTURES],
)
def test_every_kernel_compiles_without_a_warning_and_keeps_to_its_registers(architecture: str) -> None:
    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(lambda f: cubins.compiled(f, architecture, kernels.TELL), cubins.PROGRAMS))
    for features, program in zip(cubins.PROGRAMS, made, strict=True):
        assert kernels.remarks(program.log) == "", f"{features} features: {program.log}"
        used = {usage.kernel: usage for usage in kernels.usages(program.log)}
        for usage in used.values():
            assert usage.spilled <= MOST_SPILLED.get(features, 0), usage
            assert usage.shared <= 48 << 10 and kernels.blocks_held(usage, architecture) >= 1, usage
        assert len(kernel_names(features)) >= 4
        for name in kernel_names(features):
            of_views = name in ("pack_view", "blend_backward_pose", "chain_params", "chain_pose")
            there = f".text.{name}\0".encode() in program.code
            assert there == (name in used) == (features <= 7 or not of_views), name


@pytest.fixture
def text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a small program in the kernels' place."""
    (tmp_path / "cuda").mkdir()
    for name in {*cubins.TEXTS[cubins.RASTER], *cubins.TEXTS[cubins.FIT]}:
        (tmp_path / name).write_text("#pragma once\n")
    program = tmp_path / cubins.RASTER
    program.write_text('extern "C" __global__ void nothing() {}\n')
    monkeypatch.setattr(cubins, "FOLDER", tmp_path)
    return program


def test_a_program_is_compiled_once(text: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "cache"
    code = cubins.cubin(4, "sm_80", folder)
    assert code.startswith(b"\x7fELF") and [path.read_bytes() for path in folder.iterdir()] == [code]
    monkeypatch.setattr(cubins, "compiled", lambda *_: pytest.fail("it was in the cache"))
    assert cubins.cubin(4, "sm_80", folder) == code


def test_what_decides_on_the_code_decides_on_its_place(text: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = [cubins.key_of(4, "sm_80"), cubins.key_of(7, "sm_80"), cubins.key_of(4, "sm_90")]
    (cubins.FOLDER / cubins.TEXTS[cubins.RASTER][-1]).write_text("#pragma once\n// another\n")
    keys.append(cubins.key_of(4, "sm_80"))
    monkeypatch.setattr(cubins, "compiler_version", lambda: "99.9")
    keys.append(cubins.key_of(4, "sm_80"))
    assert len(set(keys)) == len(keys)


def test_a_cache_that_cannot_be_written_is_done_without(text: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert cubins.cubin(4, "sm_80", tmp_path / "file" / "cache").startswith(b"\x7fELF")


def test_an_error_shows_the_compilers_log(text: Path) -> None:
    text.write_text("__global__ void broken() { int x = there_is_no_such_name; }\n")
    with pytest.raises(
        BackendError, match=r'sm_90 with NVRTC [\d.]+(?s:.)*identifier "there_is_no_such_name" is undefined'
    ):
        cubins.compiled(4, "sm_90")


def test_a_device_newer_than_the_compiler_gets_ptx(text: Path) -> None:
    assert cubins.target_of((9, 0)) == "sm_90" and cubins.target_of((8, 6)) == "sm_86"
    newest = cubins.target_of((99, 9))
    assert newest.startswith("compute_") and int(newest.removeprefix("compute_")) >= 120
    code = cubins.compiled(4, newest).code
    assert b".visible .entry nothing" in code and code.endswith(b"\0"), "the driver reads PTX up to a zero"


def test_a_device_older_than_the_compiler_is_named(text: Path) -> None:
    with pytest.raises(BackendError, match=r"do not compile for sm_50 with NVRTC(?s:.*)gpu-architecture"):
        cubins.compiled(4, cubins.target_of((5, 0)))


def test_a_warning_is_reported(text: Path) -> None:
    text.write_text('extern "C" __global__ void idle() { int never_used; }\n')
    assert "never_used" in cubins.compiled(4, "sm_90").log


def test_what_the_compiler_says_is_read() -> None:
    log = (
        "a.cu(3): warning #177-D: never_used\nptxas info    : 0 bytes gmem\n"
        "ptxas info    : Compiling entry function 'busy' for 'sm_90'\nptxas info    : Function properties for busy\n"
        "ptxas         .     8 bytes stack frame, 4 bytes spill stores, 12 bytes spill loads\n"
        "ptxas info    : Used 73 registers, used 1 barriers, 8 bytes cumulative stack size, 36000 bytes smem\n"
        "ptxas info    : Compile time = 1.0 ms\n"
        "ptxas info    : Compiling entry function 'idle' for 'sm_90'\nptxas info    : Function properties for idle\n"
        "ptxas         .     0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads\n"
        "ptxas info    : Used 8 registers, used 0 barriers\n"
    )
    busy, idle = kernels.usages(log)
    assert busy == ("busy", 73, 12, 36000) and idle == ("idle", 8, 0, 0)
    assert kernels.remarks(log) == "a.cu(3): warning #177-D: never_used"
    assert kernels.blocks_held(busy, "sm_90") == 3, "65536 registers, 80 × 256 a block"
    assert kernels.blocks_held(busy, "sm_86") == 2, "100 KiB, 36000 + 1024 bytes a block"
    assert kernels.blocks_held(idle, "sm_90") == 8 and kernels.blocks_held(idle, "sm_75") == 4, "2048 and 1024 threads"
    rows = [{"architecture": "sm_90", "features": f, **busy._asdict(), "blocks": 3} for f in (4, 7)]
    (made,) = kernels.sections({"figures": {"compiler": "13.0", "kernels": rows}})
    assert made.rows == [["busy", "4, 7", "73", "12", "36000", "3"]]
