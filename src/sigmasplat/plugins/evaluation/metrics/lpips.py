"""Score a rendered image by LPIPS (Zhang et al. 2018), version 0.1, with weights from the public files.

DIR/alex.pth  DIR/alexnet-owt-7be5be79.pth    linear layers of lpips 0.1.4; AlexNet of torchvision
DIR/vgg.pth   DIR/vgg16-397923af.pth          the same for VGG16
"""

from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import ConfigError

Net = Literal["alex", "vgg"]
Pixels = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Convolution:
    """A convolution of a network, followed by a ReLU.

    number: of the layer in torchvision's `features`; pool_px: side of the maxima (stride 2) before it, 0 = none;
    scored: whether its output is compared.
    """

    number: int
    inputs: int
    outputs: int
    kernel_px: int = 3
    stride: int = 1
    padding: int = 1
    pool_px: int = 0
    scored: bool = True


def _vgg16() -> tuple[Convolution, ...]:
    """Return the 13 convolutions of VGG16; the last one of each block is scored."""
    layers, number, inputs = list[Convolution](), 0, 3
    for block, (count, outputs) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))):
        for i in range(count):
            pool_px = 2 if block and not i else 0
            layers.append(Convolution(number, inputs, outputs, pool_px=pool_px, scored=i == count - 1))
            number, inputs = number + 2, outputs
        number += 1
    return tuple(layers)


LAYERS: dict[Net, tuple[Convolution, ...]] = {
    "alex": (
        Convolution(0, 3, 64, kernel_px=11, stride=4, padding=2),
        Convolution(3, 64, 192, kernel_px=5, padding=2, pool_px=3),
        Convolution(6, 192, 384, pool_px=3),
        Convolution(8, 384, 256),
        Convolution(10, 256, 256),
    ),
    "vgg": _vgg16(),
}
TRUNKS: dict[Net, str] = {"alex": "alexnet-owt-*.pth", "vgg": "vgg16-*.pth"}
"""Names of torchvision's files: the end is the start of their SHA-256."""
LEAST_PX: dict[Net, int] = {"alex": 31, "vgg": 16}
"""The last feature map of a smaller image would be empty."""
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
"""Normalisation of colours in [−1, 1]."""
EPSILON = 1e-10


@dataclass(frozen=True, eq=False)
class Lpips:
    """A network and its linear layers, float32.

    convolutions: weight [out, in, k, k] and bias [out] of each layer of `LAYERS`; linear: weights [C] of the scored
    layers.
    """

    net: Net
    convolutions: tuple[tuple[Tensor, Tensor], ...]
    linear: tuple[Tensor, ...]

    @staticmethod
    def load(folder: Path, net: Net = "alex") -> "Lpips":
        """Read the two files of a network from a folder or its subfolder `net`.

        Raises ConfigError if a file is missing or unreadable, or if a tensor is missing, of another shape or not
        finite.
        """
        trunk, linear = (_tensors(_find(folder, net, name)) for name in (TRUNKS[net], f"{net}.pth"))
        layers = LAYERS[net]
        convolutions = tuple(
            (
                trunk.take(f"features.{c.number}.weight", c.outputs, c.inputs, c.kernel_px, c.kernel_px),
                trunk.take(f"features.{c.number}.bias", c.outputs),
            )
            for c in layers
        )
        scored = [c for c in layers if c.scored]
        weights = tuple(linear.take(f"lin{i}.model.1.weight", 1, c.outputs, 1, 1) for i, c in enumerate(scored))
        return Lpips(net, convolutions, tuple(weight.flatten() for weight in weights))

    def distance(self, rendered: Pixels, recorded: Pixels) -> float:
        """Return the distance of two images [H, W, 3] in [0, 1], 0 if they are equal: the sum over the layers.

        nan if a side is shorter than `LEAST_PX`.
        """
        return float(self.layer_distances(rendered, recorded).sum())

    @torch.inference_mode()
    def layer_distances(self, rendered: Pixels, recorded: Pixels) -> NDArray[np.float64]:
        """Return the distance of each scored layer [5] (Zhang et al. 2018, eq. 1): the mean over pixels of the weighted
        squared difference of unit features."""
        if min(rendered.shape[:2]) < LEAST_PX[self.net]:
            return np.full(len(self.linear), np.nan)
        pairs = zip(self._features(rendered), self._features(recorded), strict=True)
        return np.array(
            [
                float(((a - b) ** 2 * weight[:, None, None]).sum(0).mean())
                for (a, b), weight in zip(pairs, self.linear, strict=True)
            ]
        )

    def _features(self, image: Pixels) -> list[Tensor]:
        """Return the features [C, H', W'] of the scored layers, of unit norm at every pixel."""
        x = 2.0 * torch.tensor(image, dtype=torch.float32).permute(2, 0, 1) - 1.0
        x = (x - SHIFT[:, None, None]) / SCALE[:, None, None]
        found = []
        for layer, (weight, bias) in zip(LAYERS[self.net], self.convolutions, strict=True):
            if layer.pool_px:
                x = F.max_pool2d(x[None], layer.pool_px, 2)[0]
            x = F.relu(F.conv2d(x[None], weight, bias, layer.stride, layer.padding)[0])
            if layer.scored:
                found.append(x / (x.square().sum(0, keepdim=True).sqrt() + EPSILON))
        return found


def find_lpips(folder: Path, net: Net = "alex") -> tuple[Lpips | None, str]:
    """Load a network if its files exist; else return None and a line that says which file is missing.

    Raises ConfigError if a file exists but cannot be used.
    """
    try:
        for name in (f"{net}.pth", TRUNKS[net]):
            _find(folder, net, name)
    except ConfigError as missing:
        return None, f"LPIPS is not scored: {missing}"
    return Lpips.load(folder, net), ""


@dataclass(frozen=True, eq=False)
class _TensorFile:
    path: Path
    tensors: dict[str, Tensor]

    def take(self, name: str, *shape: int) -> Tensor:
        """Return a tensor of the given shape as float32. Raises ConfigError if it is missing, of another shape, or not
        finite."""
        tensor, expected = self.tensors.get(name), " × ".join(map(str, shape))
        if not isinstance(tensor, Tensor):
            raise ConfigError(f"{self.path}: {name} is missing (expected {expected}); download the file again")
        if tuple(tensor.shape) != shape:
            found = " × ".join(map(str, tensor.shape)) or "a single number"
            raise ConfigError(
                f"{self.path}: {name} is {found}, expected {expected}; is this the file of another network?"
            )
        if not torch.isfinite(tensor).all():
            raise ConfigError(f"{self.path}: {name} holds NaN or inf; download the file again")
        return tensor.float()


def _find(folder: Path, net: Net, name: str) -> Path:
    """Return the file of a name pattern in a folder or its subfolder `net`. Raises ConfigError if there is none."""
    if net not in get_args(Net):
        raise ConfigError(f"no LPIPS network {net!r}; there are {', '.join(get_args(Net))}")
    for place in (folder, folder / net):
        if found := sorted(place.glob(name)):
            return found[-1]
    raise ConfigError(f"no {name} in {folder}; download it with: sigmasplat download lpips {net}")


def _tensors(path: Path) -> _TensorFile:
    """Read a state_dict. Raises ConfigError if the file is damaged or contains more than tensors."""
    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as problem:
        raise ConfigError(
            f"{path}: contains more than tensors, or is damaged; loading it could run any code; download it again"
        ) from problem
    except Exception as problem:  # damaged bytes cause many kinds of exceptions
        reason = " ".join(f"{type(problem).__name__}: {problem}".split())[:200]
        raise ConfigError(f"{path}: unreadable as weights of LPIPS ({reason}); download the file again") from problem
    if not isinstance(loaded, dict):
        raise ConfigError(f"{path}: holds {type(loaded).__name__}, expected a state_dict; download the file again")
    return _TensorFile(path, loaded)
