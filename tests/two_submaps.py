"""Two submaps before one wall, on plain torch: what the tests of the final map share."""

from dataclasses import replace

import numpy as np
import torch

from paper_settings import FinalConfig, MappingConfig, RenderConfig, paper_settings
from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.render import render

CAMERA = Camera(20, 15, 16.0, 16.0, 9.5, 7.0)
CONFIG = paper_settings(backend="reference", mapping=MappingConfig(weight_nll_color=1e-3, prune_opacity=0.1))
WALL_M, SPACING_M = 1.55, 0.1
ANCHORS = [np.eye(4), se3.exp(np.array([0.5, 0.1, -0.2, 0.1, -0.3, 0.05]))]
LOG_VARIANCES = (-3.0, -6.0)


def config(**final: object) -> Config:
    return replace(CONFIG, final=FinalConfig(**{"spacing_m": SPACING_M, "merge_m": SPACING_M, **final}))  # type: ignore[arg-type]


def color_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 + 0.3 * np.stack([np.sin(3 * x), np.cos(4 * y), np.sin(2 * x + 3 * y)], -1)


def wall(x_from: float, x_to: float) -> GaussianField:
    """Cover z = 1.55 m of the world with splats 10 cm apart."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(x_from + 0.05, x_to, 0.1), np.arange(-0.75, 0.8, 0.1)))
    means, colors = np.stack([x, y, np.full(x.shape, WALL_M)], 1), color_at(x, y)
    values = [torch.as_tensor(v).float() for v in (means, np.full(len(x), 0.06), colors)]
    return GaussianField.from_values(*values, opacities=0.95)


def poses(submap: int, keyframes: int = 3) -> list[np.ndarray]:
    """Return T_world_camera of a submap's keyframes: side by side before its half of the wall."""
    return [se3.exp(np.array([0.4 * submap + 0.06 * k - 0.2, 0.03 * k, 0, 0, 0.05 * k, 0])) for k in range(keyframes)]


def look(T_world_camera: np.ndarray, field: GaussianField) -> Picture:
    """Take a picture of a field that is in the world."""
    seen = render(
        field, CAMERA, torch.as_tensor(se3.inverse(T_world_camera)), options=RenderConfig(), backend="reference"
    )
    depth_m = np.where(seen.alpha > 0.5, seen.depth / seen.alpha.clamp(min=0.5), 0.0).astype(np.float32)
    return Picture((seen.color.clamp(0, 1) * 255).round().byte().numpy(), depth_m)


def make_store(spoil: float = 0.0) -> MemoryStore:
    """Make two submaps of overlapping parts of the wall, their colours spoiled; the second is the steadier."""
    store, rng = MemoryStore(), np.random.default_rng(0)
    world = wall(-1.4, 1.6)
    for index, part in enumerate((wall(-1.4, 0.4), wall(-0.2, 1.6))):
        field = part.moved(torch.as_tensor(se3.inverse(ANCHORS[index])))
        field.params[:, COLUMNS["log_variances"]] = LOG_VARIANCES[index]
        field.params[:, COLUMNS["colors"]] += torch.as_tensor(rng.normal(0, spoil, (len(field), 3))).float()
        T = np.array([se3.inverse(ANCHORS[index]) @ pose for pose in poses(index)])
        store.save(Submap(index, field, (0, 1, 2), T, CAMERA), [look(pose, world) for pose in poses(index)])
    return store
