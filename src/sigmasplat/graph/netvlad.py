"""Describe places by NetVLAD (Arandjelović et al. 2016), with weights from a file of the user."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.io import loadmat
from torch import Tensor

from sigmasplat.errors import ConfigError

LAYER_NUMBERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Numbers of the convolutions of VGG16 up to conv5_3 in the file, which counts ReLUs and poolings too. NetVLAD omits
the ReLU and the pooling after the last one."""
POOLED_BEFORE = (5, 10, 17, 24)
"""The first convolution of each block but the first."""
SMALLEST_PX = 2 ** len(POOLED_BEFORE)
VLAD_LAYER, WHITEN_LAYER = 30, 33
MEAN_IMAGE = "net.meta.normalization.averageImage"
FORMAT = "hloc's VGG16-NetVLAD-Pitts30K.mat"


@dataclass(frozen=True, eq=False)
class NetVladWeights:
    """VGG16 and the NetVLAD layer in float32; the shapes give the width of the network.

    convolutions: 13 of weight [out, in, 3, 3] and bias [out], the last out = D; assign [K, D]: the soft assignment to K
    clusters; centroids [K, D]; whitening: weight [P, K · D] and bias [P] of the PCA over all clusters, if any. The
    input of the network is RGB in 0…255 minus mean [3].
    """

    convolutions: list[tuple[Tensor, Tensor]]
    assign: Tensor
    centroids: Tensor
    whitening: tuple[Tensor, Tensor] | None
    mean: Tensor

    @staticmethod
    def load(path: Path | str) -> "NetVladWeights":
        """Read the Matlab file of the paper's authors, which hloc offers.

        Raises ConfigError naming the file, and the tensor with its actual and expected shape, if a tensor does not fit.
        """
        try:
            tensors = _read(Path(path))
        except Exception as problem:  # damaged bytes cause many kinds of exceptions
            reason = " ".join(f"{type(problem).__name__}: {problem}".split())[:200]
            raise ConfigError(f"{path}: unreadable as NetVLAD weights ({reason}); give {FORMAT}") from problem
        return _TensorFile(Path(path), tensors).weights()


@dataclass(frozen=True, eq=False)
class NetVlad:
    """A `Descriptor` of colour alone."""

    weights: NetVladWeights

    @torch.inference_mode()
    def describe(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return float32 [P], or [K · D] without whitening, of unit norm (`Descriptor.describe`).

        Raises ConfigError if the image is smaller than 16 pixels, because its feature map would be empty.
        """
        image = torch.tensor(color, dtype=torch.float32).permute(2, 0, 1)[None]
        if min(image.shape[2:]) < SMALLEST_PX:
            raise ConfigError(
                f"NetVLAD needs images of at least {SMALLEST_PX} pixels in each direction, found {image.shape[3]}×"
                f"{image.shape[2]}; raise input.width, or use the built-in descriptor"
            )
        return self._vlad(_vgg(self.weights, image * 255.0 - self.weights.mean[:, None, None])).numpy()

    def _vlad(self, features: Tensor) -> Tensor:
        """Sum residuals to the clusters, features [D, pixels]: V_k = Σ a_k (x − c_k); normalise per k, then all."""
        w = self.weights
        x = F.normalize(features, dim=0)
        a = torch.softmax(w.assign @ x, dim=0)
        residuals = a @ x.T - a.sum(1, keepdim=True) * w.centroids
        vector = F.normalize(F.normalize(residuals, dim=1).flatten(), dim=0)
        if w.whitening is None:
            return vector
        return F.normalize(w.whitening[0] @ vector + w.whitening[1], dim=0)


def _vgg(weights: NetVladWeights, image: Tensor) -> Tensor:
    """Return conv5_3 [D, pixels] of an image [1, 3, H, W], before its ReLU."""
    x = image
    for number, (weight, bias) in zip(LAYER_NUMBERS, weights.convolutions, strict=True):
        if number:
            x = F.relu(x)
        if number in POOLED_BEFORE:
            x = F.max_pool2d(x, 2)
        x = F.conv2d(x, weight, bias, padding=1)
    return x[0].flatten(1)


def _read(path: Path) -> dict[str, Tensor]:
    """Return the tensors of the layers, in PyTorch's order of axes, and the mean image's first pixel, by their names in
    the file."""
    with path.open("rb") as stream:
        if stream.read(6) != b"MATLAB":
            raise ValueError("it is no Matlab file")
    given = loadmat(path, appendmat=False, struct_as_record=False, squeeze_me=True, variable_names=["net"])
    net, tensors = given["net"], dict[str, Tensor]()
    for i, layer in enumerate(np.ravel(net.layers)):
        for j, weights in enumerate(np.ravel(getattr(layer, "weights", ()))):
            # loadmat reverses the order of axes: [height, width, in, out], [D, K].
            array = np.asarray(weights, np.float32).T
            array = array.swapaxes(2, 3) if array.ndim == 4 else array
            tensors[f"net.layers[{i}].weights[{j}]"] = torch.tensor(array.copy())
    image = np.asarray(net.meta.normalization.averageImage, np.float32)
    return tensors | {MEAN_IMAGE: torch.tensor(image.reshape(-1, image.shape[-1])[0])}


@dataclass(frozen=True, eq=False)
class _TensorFile:
    """The tensors of a file by their names there."""

    path: Path
    tensors: dict[str, Tensor]

    def take(self, name: str, *shape: int | None) -> Tensor:
        """Return a tensor as float32 of the given shape, None = any.

        Raises ConfigError if it is missing, of another shape, or not finite.
        """
        where = f"{self.path}: {name}"
        expected = " × ".join("any" if size is None else str(size) for size in shape)
        if name not in self.tensors:
            raise ConfigError(f"{where} is missing (expected {expected}); give {FORMAT}")
        tensor = self.tensors[name]
        if tensor.ndim != len(shape) or any(s not in (f, None) for f, s in zip(tensor.shape, shape, strict=True)):
            sizes = " × ".join(map(str, tensor.shape)) or "a single number"
            raise ConfigError(f"{where} is {sizes}, expected {expected}; give {FORMAT}")
        if not torch.isfinite(tensor).all():
            raise ConfigError(f"{where} holds NaN or inf, expected finite weights; download the file again")
        # A copy, because the last bits of a product depend on memory alignment, which differs from file to file.
        return torch.empty(tensor.shape).copy_(tensor)

    def layer(self, number: int, *shape: int | None) -> tuple[Tensor, Tensor]:
        """Return the weight of a layer, of the given shape, and its bias."""
        weight = self.take(f"net.layers[{number}].weights[0]", *shape)
        return weight, self.take(f"net.layers[{number}].weights[1]", len(weight))

    def weights(self) -> NetVladWeights:
        """Check that all tensors fit together, and return the weights."""
        chain, width = list[tuple[Tensor, Tensor]](), 3
        for number in LAYER_NUMBERS:
            chain.append(self.layer(number, None, width, 3, 3))
            width = len(chain[-1][0])
        vlad, whitening = f"net.layers[{VLAD_LAYER}].weights", None
        centroids = -self.take(f"{vlad}[1]", None, width)  # the file contains −c_k
        count = len(centroids)
        if f"net.layers[{WHITEN_LAYER}].weights[0]" in self.tensors:
            pca, bias = self.layer(WHITEN_LAYER, None, count * width)
            # from "clusters of one feature" to "features of one cluster"
            whitening = pca.reshape(-1, width, count).transpose(1, 2).flatten(1), bias
        return NetVladWeights(
            chain, self.take(f"{vlad}[0]", count, width), centroids, whitening, self.take(MEAN_IMAGE, 3)
        )
