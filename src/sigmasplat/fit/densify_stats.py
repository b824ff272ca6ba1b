"""Statistics of a fit that densification reads."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmasplat.fit.target import Keyframe


@dataclass(eq=False)
class DensifyStats:
    """How strongly one keyframe's loss pulls at the image means of N splats (3DGS): the sum over steps [N], and the
    number of steps that saw each splat [N]. Rows that are dropped or added make it invalid."""

    keyframe: Keyframe
    grad2d: Tensor
    times: Tensor

    @staticmethod
    def of(keyframe: Keyframe, n: int, device: torch.device | None = None) -> "DensifyStats":
        """Start at 0 for n splats, on a device; by default in the host's memory."""
        return DensifyStats(keyframe, torch.zeros(n, device=device), torch.zeros(n, device=device))

    def on_gradient(self, keyframe: Keyframe, grad2d: Tensor) -> None:
        """Add one step's norms [N] ≥ 0, 0 for a splat that was not seen. Other keyframes than its own are ignored."""
        if keyframe is self.keyframe:
            self.grad2d += grad2d
            self.times += grad2d > 0
