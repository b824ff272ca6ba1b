"""Compile every CUDA kernel for every architecture, as a device would at first use; no GPU is needed."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from sigmasplat.errors import BackendError
from sigmasplat.native import cubins

pytest.importorskip("cuda.core", reason="cuda-core is not installed: pip install 'sigmasplat[gpu]'")
pytest.importorskip("cuda.bindings.nvrtc", reason="cuda-bindings is not installed: pip install 'sigmasplat[gpu]'")


@pytest.mark.parametrize("architecture", cubins.ARCHITECTURES)
def test_every_kernel_compiles_without_a_warning(architecture: str) -> None:
    with ThreadPoolExecutor(2) as pool:
        made = list(pool.map(lambda features: cubins.compiled(features, architecture), cubins.PROGRAMS))
    for features, program in zip(cubins.PROGRAMS, made, strict=True):
        assert program.log == "", f"{features} features: {program.log}"
        assert len(cubins.kernel_names(features)) >= 4
        for name in cubins.kernel_names(features):
            of_views = name in ("pack_view", "blend_backward_pose", "chain_params", "chain_pose")
            assert (f".text.{name}\0".encode() in program.code) == (features <= 7 or not of_views), name


@pytest.fixture
def text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a small program in the kernels' place."""
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
    (text.parent / cubins.TEXTS[cubins.RASTER][-1]).write_text("#pragma once\n// another\n")
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


def test_a_warning_is_reported(text: Path) -> None:
    text.write_text('extern "C" __global__ void idle() { int never_used; }\n')
    assert "never_used" in cubins.compiled(4, "sm_90").log
