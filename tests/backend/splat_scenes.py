"""Make scenes that stress a splat rasteriser, and compare gradients as vectors."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera

SMALL = Camera(16, 12, 14.0, 15.0, 7.1, 6.4)
WIDE = Camera(45, 31, 40.0, 42.0, 21.3, 17.8)
"""Not a multiple of any tile, principal point off centre."""
FIELD = ("means", "quats", "scales", "opacities", "features")
KINDS = ("random", "needles", "huge", "near_plane", "off_screen", "overlapping")


@dataclass(frozen=True, eq=False)
class Scene:
    """Splats, a camera and a sensor depth; float64 unless converted."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    ref_depth: Tensor
    T_camera_world: Tensor
    camera: Camera
    options: RenderConfig

    def to(self, dtype: torch.dtype) -> "Scene":
        """Convert every tensor."""
        tensors = {k: v.to(dtype) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **tensors)

    def with_options(self, **options: Any) -> "Scene":
        """Change render options."""
        return replace(self, options=replace(self.options, **options))

    def requiring_grad(self) -> "Scene":
        """Return leaves that collect gradients."""
        names = (*FIELD, "T_camera_world")
        return replace(self, **{k: getattr(self, k).detach().clone().requires_grad_() for k in names})


def _placed(kind: str, n: int, camera: Camera, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Choose pixels and depths [N, 3], scales [N, 3] in metres and opacities [N] of one kind of scene."""
    u, v = rng.uniform(0, camera.width, n), rng.uniform(0, camera.height, n)
    z, opacities = rng.uniform(0.6, 4.0, n), rng.uniform(0.1, 0.999, n)
    scales = np.exp(rng.uniform(np.log(0.02), np.log(0.3), (n, 3)))
    if kind == "needles":
        scales = rng.uniform(0.5, 1.5, (n, 3)) * [0.3, 0.003, 0.003]
    elif kind == "huge":
        scales, opacities = rng.uniform(0.5, 2.0, (n, 3)), rng.uniform(0.05, 0.6, n)
    elif kind == "near_plane":
        z, scales = rng.uniform(0.03, 0.2, n), rng.uniform(0.003, 0.03, (n, 3))
    elif kind == "off_screen":
        u, v = u * 2.6 - 0.8 * camera.width, v * 2.6 - 0.8 * camera.height
        scales = rng.uniform(0.1, 0.5, (n, 3))
        z[::5] *= -1
    elif kind == "overlapping":
        u, v = camera.cx + rng.normal(size=n), camera.cy + rng.normal(size=n)
        z, opacities = rng.uniform(1.0, 1.3, n), rng.uniform(0.3, 0.95, n)
    return np.stack([u, v, z], 1), scales, opacities


def make(kind: str, n: int, camera: Camera, seed: int, channels: int = 4) -> Scene:
    """Make a scene from a seed; its values are exact in float32, so that both precisions see one scene."""
    rng = np.random.default_rng(seed)
    uvz, scales, opacities = _placed(kind, n, camera, rng)
    u, v, z = uvz.T
    in_camera = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    T = se3.exp(rng.normal(size=6) * 0.7)
    ref = rng.uniform(0.6, 4.0, (camera.height, camera.width)) * (rng.random((camera.height, camera.width)) > 0.2)
    means = (in_camera - T[:3, 3]) @ T[:3, :3]
    values = (means, rng.normal(size=(n, 4)), scales, opacities, rng.uniform(0, 1, (n, channels)), ref, T)
    return Scene(*(torch.tensor(x, dtype=torch.float32).double() for x in values), camera, RenderConfig())


@lru_cache(maxsize=64)
def scene(kind: str, n: int, camera: Camera = WIDE, margin: float = 1e-4, seed: int = 0, channels: int = 4) -> Scene:
    """Make a scene in which no decision is within `margin` of flipping: the first such seed from 1000·seed on."""
    from splat_oracle import look

    for attempt in range(1000 * seed, 1000 * (seed + 1)):
        candidate = make(kind, n, camera, attempt, channels)
        if look(candidate).margin > margin:
            return candidate
    raise AssertionError(f"no {kind} scene of {n} splats keeps {margin} from every threshold")


def render(backend: Any, s: Scene) -> tuple[Any, Any]:
    """Project and blend."""
    p = backend.project(s.means, s.quats, s.scales, s.T_camera_world, s.camera, s.options)
    return p, backend.blend(*p, s.opacities, s.features, s.ref_depth, s.camera, s.options)


def probe(*outputs: Tensor) -> Tensor:
    """Reduce maps to one number with fixed random weights, so that its gradient tests every output at once."""
    rng = np.random.default_rng(7)
    return torch.stack([(torch.as_tensor(rng.normal(size=tuple(x.shape))).to(x) * x).sum() for x in outputs]).sum()


def gradients(backend: Any, s: Scene) -> dict[str, Tensor]:
    """Differentiate the probe of sums, moment and alpha by every field tensor and the pose twist (left, ρ then φ)."""
    leaves = s.requiring_grad()
    _, b = render(backend, leaves)
    probe(b.sums, b.moment, b.alpha).backward()
    found = {name: getattr(leaves, name).grad for name in FIELD}
    pose = leaves.T_camera_world.grad
    return found | {"pose": torch.zeros(6) if pose is None else twist_gradient(pose, s.T_camera_world)}


def twist_gradient(matrix_gradient: Tensor, T: Tensor) -> Tensor:
    """Turn ∂L/∂T [4, 4] into ∂L/∂ξ [6] of exp(ξ)·T at ξ = 0."""
    G, T = matrix_gradient.double().numpy(), T.double().numpy()
    torque = np.cross(T[:3].T, G[:3].T).sum(0)
    return torch.as_tensor(np.concatenate([G[:3, 3], torque]))


def twist_differences(loss: Callable[[Tensor], Any], T: Tensor, step: float) -> Tensor:
    """Differentiate a loss of a pose by the twist [6] of exp(ξ)·T, central differences, float64."""
    out = []
    for e in np.eye(6):
        ahead, behind = (float(loss(torch.as_tensor(se3.exp(sign * step * e)) @ T)) for sign in (1, -1))
        out.append((ahead - behind) / (2 * step))
    return torch.tensor(out, dtype=torch.float64)


def assert_same_vector(got: Tensor, want: Tensor, relative: float = 1e-4, what: str = "") -> None:
    """Hold two gradients together as vectors: direction, length and difference."""
    a, b = got.detach().double().flatten(), want.detach().double().flatten()
    length = float(b.norm())
    assert length > 0, f"{what}: the expected gradient is zero, the test proves nothing"
    cosine, ratio = float(a @ b / (a.norm() * length)), float(a.norm()) / length
    error = float((a - b).norm()) / length
    report = f"{what}: cosine {cosine:.8f}, norm ratio {ratio:.6f}, relative error {error:.2e}"
    assert cosine > 0.9999 and abs(ratio - 1) < 1e-3 and error < relative, report
