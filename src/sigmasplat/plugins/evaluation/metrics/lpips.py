"""Score a rendered image by LPIPS (Zhang et al. 2018), version 0.1 with AlexNet, with weights from the public files.

DIR/alex.pth  DIR/alexnet-owt-7be5be79.pth    linear layers of lpips 0.1.4; AlexNet of torchvision
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sigmasplat.api import ConfigError

Pixels = NDArray[np.floating[Any]]
TRUNK, LINEAR = "alexnet-owt-*.pth", "alex.pth"
"""Names of the files; the end of torchvision's is the start of its SHA-256."""
CHANNELS = (64, 192, 384, 256, 256)
LEAST_PX = 31
"""The last feature map of a smaller image would be empty."""
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
"""Normalisation of colours in [−1, 1]."""
EPSILON = 1e-10


def _alexnet() -> nn.Sequential:
    """Return torchvision's `alexnet().features`; what follows each convolution's ReLU is compared."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Lpips:
    """AlexNet's features and the weights [C] of its five layers, float32."""

    features: nn.Sequential
    linear: tuple[Tensor, ...]
    net: str = "alex"

    @staticmethod
    def load(folder: Path) -> "Lpips":
        """Read both files from a folder or its subfolder `alex`.

        Raises ConfigError if a file is missing or unreadable, or if a tensor is missing, of another shape or not
        finite.
        """
        with torch.device("meta"):  # no random numbers are drawn
            features, heads = _alexnet(), nn.ModuleList(nn.Conv2d(count, 1, 1, bias=False) for count in CHANNELS)
        for module, name, prefix in ((features, TRUNK, "features."), (heads, LINEAR, "lin")):
            path = _find(folder, name)
            tensors = {key.removeprefix(prefix): t for key, t in _tensors(path).items() if key.startswith(prefix)}
            try:
                named = {key.replace(".model.1", ""): tensor for key, tensor in tensors.items()}
                module.requires_grad_(False).load_state_dict(named, assign=True)
            except (RuntimeError, AttributeError) as problem:
                what = " ".join(str(problem).split())[:300]
                raise ConfigError(f"{path}: not the weights of AlexNet for LPIPS ({what}); download it again") from None
            if not all(torch.isfinite(tensor).all() for tensor in module.state_dict().values()):
                raise ConfigError(f"{path}: holds NaN or inf; download the file again")
        return Lpips(features.float(), tuple(weight.float().flatten() for weight in heads.parameters()))

    @torch.inference_mode()
    def distance(self, rendered: Pixels, recorded: Pixels) -> float:
        """Return the distance of two images [H, W, 3] in [0, 1], 0 if they are equal: the sum over the layers of the
        mean over pixels of the weighted squared difference of unit features (Zhang et al. 2018, eq. 1).

        nan if a side is shorter than `LEAST_PX`.
        """
        if min(rendered.shape[:2]) < LEAST_PX:
            return float("nan")
        pairs = zip(self._unit_features(rendered), self._unit_features(recorded), self.linear, strict=True)
        return sum(float(((a - b) ** 2 * weight[:, None, None]).sum(0).mean()) for a, b, weight in pairs)

    def _unit_features(self, image: Pixels) -> list[Tensor]:
        """Return the features [C, H', W'] of the layers, of unit norm at every pixel."""
        x = 2.0 * torch.tensor(image, dtype=torch.float32).permute(2, 0, 1) - 1.0
        x, found = (x - SHIFT[:, None, None]) / SCALE[:, None, None], []
        for layer in self.features:
            x = layer(x[None])[0]
            if isinstance(layer, nn.ReLU):
                found.append(x / (x.square().sum(0, keepdim=True).sqrt() + EPSILON))
        return found


def find_lpips(folder: Path) -> tuple[Lpips | None, str]:
    """Load the network if its files exist; else return None and a line that says which file is missing.

    Raises ConfigError if a file exists but cannot be used.
    """
    try:
        for name in (LINEAR, TRUNK):
            _find(folder, name)
    except ConfigError as missing:
        return None, f"LPIPS is not scored: {missing}"
    return Lpips.load(folder), ""


def _find(folder: Path, name: str) -> Path:
    """Return the file of a name pattern in a folder or its subfolder `alex`. Raises ConfigError if there is none."""
    for place in (folder, folder / "alex"):
        if found := sorted(place.glob(name)):
            return found[-1]
    raise ConfigError(f"no {name} in {folder}; download it with: sigmasplat download lpips alex")


def _tensors(path: Path) -> Mapping[str, Any]:
    """Read a state_dict. Raises ConfigError if the file is damaged or contains more than tensors."""
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))  # other content could run any code
    except Exception as problem:  # damaged bytes cause many kinds of exceptions
        reason = " ".join(f"{type(problem).__name__}: {problem}".split())[:200]
        raise ConfigError(f"{path}: unreadable as weights of LPIPS ({reason}); download the file again") from problem
