"""Write and read named tensors with text metadata (safetensors), completely or not at all."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from torch import Tensor

from sigmasplat.errors import RunError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.reading import DAMAGED, cause, refuse_special

ERRORS: tuple[type[Exception], ...] = (SafetensorError, *DAMAGED)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], text: dict[str, str]) -> None:
    """Write a file atomically. Raises RunError if it cannot be written."""
    with replacing(path) as temporary:
        # safetensors makes a file that only its owner can read; a new file of ours has the usual permissions.
        temporary.unlink(missing_ok=True)
        temporary.touch()
        permissions = temporary.stat().st_mode
        try:
            # safetensors.torch would keep some kB for each new size of a tensor: numpy.ctypeslib makes a type for it.
            arrays = {name: tensor.detach().cpu().contiguous().numpy() for name, tensor in tensors.items()}
            save_file(arrays, temporary, text)
            if tensors and len(text) > 1:
                _sort_metadata(temporary)
        except SafetensorError as problem:  # also raised if the disk is full
            raise RunError(f"cannot write {path}: {problem}; choose a writable place") from problem
        temporary.chmod(permissions)


@contextmanager
def open_tensors(path: Path, what: str, arrays: bool = False) -> Iterator[Any]:
    """Open a file to read tensors or parts of them (`safe_open`); error messages call it `what`.

    arrays: it yields NumPy arrays instead of tensors. Files that are read again and again need them: with tensors,
    safetensors keeps some bytes for each one. Raises RunError if the file is damaged, or if the block does not find a
    tensor or cannot use it.
    """
    try:
        refuse_special(path, RunError)
        with safe_open(path, "np" if arrays else "pt") as file:
            yield file
    except ERRORS as problem:
        raise RunError(f"{what} {path} is damaged: {cause(problem)}") from problem


def _sort_metadata(path: Path) -> None:
    """Sort the text metadata in a file's header: safetensors writes it in a random order, so bytes would differ."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) <= size:  # the header is padded with spaces
            file.seek(8)
            file.write(text.ljust(size))
