"""Fixtures for every test folder: where real sequences lie, and a tiny recorded sequence to damage."""

import gc
import json
import os
import signal
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

# Workers of pytest-xdist share the cores; numpy and torch read this when they are imported.
if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 0)):
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // workers)))

import numpy as np
import pytest
from PIL import Image

import sigmasplat  # noqa: F401 - before any test imports torch: idle OpenMP threads then sleep (sigmasplat.env), 5× faster

# Imports and the collection of tests make millions of objects that stay: the collector would walk them again and again.
gc.disable()

# A shell that starts tests in the background has them ignore Ctrl-C, which some of them are about.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Their assertions explain themselves as those of tests do.
pytest.register_assert_rewrite("benchmark_results", "command_line", "run_process")

TINY_SIZE = (32, 24)  # width, height
TINY_DEPTH_M = 2.0


def pytest_collection_finish() -> None:
    """Let the collector walk from now on what tests make, and nothing that is there already."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True, scope="session")
def files_are_not_synced() -> Iterator[None]:
    """Do not wait for the disk, 5 ms for each file that a run writes: after the tests nobody needs them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)  # as fsync does, it refuses what is no file
        yield


@pytest.fixture(autouse=True, scope="session")
def views_of_the_room() -> Iterator[None]:
    """Render each view of the synthetic room once: many runs of this process begin with the same frames."""
    from sigmasplat.plugins.sources import synthetic

    @lru_cache(maxsize=600)
    def rendered(scene: Any, camera: Any, pose: bytes, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        return render_scene(scene, camera, np.frombuffer(pose).reshape(shape))

    def remembered(scene: Any, camera: Any, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        color, depth_m = rendered(scene, camera, np.asarray(T_world_camera, np.float64).tobytes(), T_world_camera.shape)
        return color.copy(), depth_m.copy()

    render_scene = synthetic.render_scene
    synthetic.render_scene = remembered
    yield
    synthetic.render_scene = render_scene


@pytest.fixture
def data_folder() -> Callable[[str], Path]:
    """Find a real sequence by name under $SIGMASPLAT_DATA or ../shared/data; skip the test where it is absent."""
    root = Path(os.environ.get("SIGMASPLAT_DATA", Path(__file__).parents[2] / "shared" / "data"))

    def find(name: str) -> Path:
        if not (root / name).is_dir():
            pytest.skip(f"no real data: {root / name} is absent (set SIGMASPLAT_DATA to the folder that holds {name}/)")
        return root / name

    return find


@pytest.fixture
def tiny_tum(tmp_path: Path) -> Path:
    """Write a TUM folder of 4 frames, 32×24, a wall 2 m ahead, by hand: no code under test is involved."""
    folder = tmp_path / "tiny"
    for part in ("rgb", "depth"):
        (folder / part).mkdir(parents=True)
    width, height = TINY_SIZE
    for i in range(4):
        color = np.random.default_rng(i).integers(0, 256, (height, width, 3), np.uint8)
        Image.fromarray(color).save(folder / f"rgb/{i}.png")
        Image.fromarray(np.full((height, width), int(1000 * TINY_DEPTH_M), np.uint16)).save(folder / f"depth/{i}.png")
    (folder / "rgb.txt").write_text("# a comment\n" + "".join(f"{i / 10:.3f} rgb/{i}.png\n" for i in range(4)))
    (folder / "depth.txt").write_text("".join(f"{i / 10 + 0.004:.3f} depth/{i}.png\n" for i in range(4)))
    (folder / "groundtruth.txt").write_text("".join(f"{i / 10:.3f} {i} 0 0 0 0 0 1\n" for i in range(4)))
    calibration = {
        "fx": 30.0,
        "fy": 30.0,
        "cx": 15.5,
        "cy": 11.5,
        "width": width,
        "height": height,
        "depth_scale": 1000.0,
    }
    (folder / "calibration.json").write_text(json.dumps(calibration))
    return folder
