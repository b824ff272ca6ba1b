"""Other programs that read maps: programs of Node from the folder SIGMASPLAT_READERS (`make readers`)."""

import csv
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sigmasplat.data.harmonics import count
from sigmasplat.run_folder.splat_values import SH_C0, SplatValues, unit

FOLDER = Path(os.environ.get("SIGMASPLAT_READERS") or Path(__file__).parents[1] / "build" / "readers").resolve()


def package(name: str) -> Path:
    """Return the folder of a package of Node; skip the test if it or Node is missing."""
    folder = FOLDER / "node_modules" / name
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip(f"{name} is not installed (make readers, or SIGMASPLAT_READERS = a folder with node_modules)")
    return folder


def run_node(*arguments: str | Path) -> str:
    """Run Node beside the packages and return its output."""
    command = ["node", *map(str, arguments)]
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def convert(given: Path, target: Path, *options: str) -> Path:
    """Convert a map with PlayCanvas's splat-transform."""
    run_node(
        package("@playcanvas/splat-transform") / "bin" / "cli.mjs", "-q", "-w", "-g", "cpu", *options, given, target
    )
    return target


def read_by_splat_transform(given: Path, folder: Path) -> SplatValues:
    """Return a map as splat-transform reads it, in the order of the file."""
    with convert(given, folder / "read.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}

    def columns(prefix: str, n: int) -> np.ndarray:
        return np.stack([column[f"{prefix}{i}"] for i in range(n)], axis=1) if n else np.empty((len(rows), 0))

    given_rest = sum(name.startswith("f_rest_") for name in column)
    rest = columns("f_rest_", given_rest).reshape(len(rows), 3, given_rest // 3).swapaxes(1, 2)
    degrees = [d for d in range(4) if 3 * count(d) >= given_rest]
    assert 3 * count(degrees[0]) == given_rest
    return SplatValues(
        np.stack([column[name] for name in "xyz"], axis=1),
        unit(columns("rot_", 4)),
        columns("scale_", 3),
        1.0 / (1.0 + np.exp(-column["opacity"])),
        columns("f_dc_", 3) * SH_C0 + 0.5,
        rest.reshape(len(rows), given_rest),
    )
