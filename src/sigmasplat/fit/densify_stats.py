"""Collect statistics of a fit for densification."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.fit.target import Keyframe


@dataclass(eq=False)
class DensifyStats:
    """Gradient of one keyframe's loss with respect to the image means of N splats (3DGS): the sum of its norms over
    steps [N], and the number of steps in which each splat was visible [N]. Invalid after rows are removed or added."""

    keyframe: Keyframe
    grad2d: Tensor
    times: Tensor

    @staticmethod
    def of(keyframe: Keyframe, n: int, device: torch.device | None = None) -> "DensifyStats":
        """Make statistics of n splats, all 0, on a device (default: host memory)."""
        return DensifyStats(keyframe, torch.zeros(n, device=device), torch.zeros(n, device=device))

    def on_gradient(self, keyframe: Keyframe, grad2d: Tensor) -> None:
        """Add the norms [N] of one step, 0 for an invisible splat. Norms of other keyframes are ignored."""
        if keyframe is self.keyframe:
            self.grad2d += grad2d
            self.times += grad2d > 0
