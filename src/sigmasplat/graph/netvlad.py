"""Describe places by NetVLAD (Arandjelović et al. 2016), with weights from a file of the user."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.io import loadmat
from torch import Tensor

from sigmasplat.errors import ConfigError

CONVOLUTIONS = tuple(f"conv{block}_{i + 1}" for block, count in enumerate((2, 2, 3, 3, 3), 1) for i in range(count))
"""The layers of VGG16 up to conv5_3; NetVLAD omits the ReLU and the pooling after it."""
POOLED_BEFORE = ("conv2_1", "conv3_1", "conv4_1", "conv5_1")
SMALLEST_PX = 2 ** len(POOLED_BEFORE)
LAYER_NUMBERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Numbers of the convolutions if ReLUs and poolings are counted too, as in both common formats."""
VLAD_LAYER, WHITEN_LAYER = 30, 33
"""Numbers of the NetVLAD layer and the whitening layer in the Matlab network."""
IMAGENET_MEAN, IMAGENET_STD = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
CAFFE_MEAN, CAFFE_STD = torch.tensor([123.68, 116.779, 103.939]) / 255.0, torch.full((3,), 1.0 / 255.0)
"""The input of OpenIBL: RGB in 0…255 minus the mean, as in the original network."""
FORMATS = "a pytorch-NetVlad checkpoint, OpenIBL's vgg16_netvlad.pth or hloc's VGG16-NetVLAD-Pitts30K.mat"


@dataclass(frozen=True, eq=False)
class NetVladWeights:
    """VGG16 and the NetVLAD layer in float32, from any file format; the shapes give the width of the network.

    convolutions: 13 of weight [out, in, 3, 3] and bias [out], the last out = D; assign [K, D] and assign_bias [K]: the
    soft assignment to K clusters; centroids [K, D]; whitening: weight [P, K · D] and bias [P] of the PCA over all
    clusters, if any. The input of the network is (RGB in [0, 1] · scale − mean [3]) / std [3].
    """

    convolutions: list[tuple[Tensor, Tensor]]
    assign: Tensor
    assign_bias: Tensor
    centroids: Tensor
    whitening: tuple[Tensor, Tensor] | None
    scale: float
    mean: Tensor
    std: Tensor

    @staticmethod
    def load(path: Path | str) -> "NetVladWeights":
        """Read a weights file of any of the three formats, which are recognised by content.

        Raises ConfigError naming the file, and the tensor with its actual and expected shape, if a tensor does not fit.
        """
        path = Path(path)
        read = _reader(path)
        try:
            file = read(path)
        except UnpicklingError as problem:
            raise ConfigError(
                f"{path}: contains more than tensors and numbers, or is damaged; loading it could run any code. "
                "If you trust its source, save only its state_dict"
            ) from problem
        except Exception as problem:  # damaged bytes cause many kinds of exceptions
            reason = " ".join(f"{type(problem).__name__}: {problem}".split())[:200]
            raise ConfigError(f"{path}: unreadable as NetVLAD weights ({reason}); give {FORMATS}") from problem
        return file.weights()


@dataclass(frozen=True, eq=False)
class NetVlad:
    """A `Descriptor` of colour alone; width: working width in pixels (0 = the image's own; it was trained at 640)."""

    weights: NetVladWeights
    width: int = 0

    @torch.inference_mode()
    def describe(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return float32 [P], or [K · D] without whitening, of unit norm (`Descriptor.describe`).

        Raises ConfigError if the image is smaller than 16 pixels at the working width, because its feature map would be
        empty.
        """
        w = self.weights
        image = torch.tensor(color, dtype=torch.float32).permute(2, 0, 1)[None]
        if self.width and self.width != image.shape[3]:
            size = (round(image.shape[2] * self.width / image.shape[3]), self.width)
            image = F.interpolate(image, size, mode="bilinear", antialias=True)
        if min(image.shape[2:]) < SMALLEST_PX:
            raise ConfigError(
                f"NetVLAD needs images of at least {SMALLEST_PX} pixels in each direction, found {image.shape[3]}×"
                f"{image.shape[2]}; raise input.width, or use the built-in descriptor"
            )
        return self._vlad(_vgg(w, (image * w.scale - w.mean[:, None, None]) / w.std[:, None, None])).numpy()

    def _vlad(self, features: Tensor) -> Tensor:
        """Sum residuals to the clusters, features [D, pixels]: V_k = Σ a_k (x − c_k). Normalise per k, then the whole
        vector."""
        w = self.weights
        x = F.normalize(features, dim=0)
        a = torch.softmax(w.assign @ x + w.assign_bias[:, None], dim=0)
        residuals = a @ x.T - a.sum(1, keepdim=True) * w.centroids
        vector = F.normalize(F.normalize(residuals, dim=1).flatten(), dim=0)
        if w.whitening is None:
            return vector
        return F.normalize(w.whitening[0] @ vector + w.whitening[1], dim=0)


def _vgg(weights: NetVladWeights, image: Tensor) -> Tensor:
    """Return conv5_3 [D, pixels] of an image [1, 3, H, W], before its ReLU."""
    x = image
    for name, (weight, bias) in zip(CONVOLUTIONS, weights.convolutions, strict=True):
        if name != CONVOLUTIONS[0]:
            x = F.relu(x)
        if name in POOLED_BEFORE:
            x = F.max_pool2d(x, 2)
        x = F.conv2d(x, weight, bias, padding=1)
    return x[0].flatten(1)


@dataclass(frozen=True, eq=False)
class _TensorFile:
    """The tensors of a file by the names used here, in PyTorch's order of axes; alias: their names in the file."""

    path: Path
    tensors: dict[str, Tensor]
    alias: dict[str, str]

    def take(self, name: str, *shape: int | None) -> Tensor:
        """Return a tensor as float32 of the given shape, None = any; dimensions of 1 at either end are ignored.

        Raises ConfigError if it is missing, of another shape, or not finite.
        """
        where = f"{self.path}: {self.alias.get(name, name)}"
        expected = " × ".join("any" if size is None else str(size) for size in shape)
        if name not in self.tensors:
            raise ConfigError(f"{where} is missing (expected {expected}); give {FORMATS}")
        tensor = self.tensors[name]
        found = list(tensor.shape)
        while len(found) > len(shape) and 1 in (found[0], found[-1]):
            found.pop(0 if found[0] == 1 else -1)
        if len(found) != len(shape) or any(s not in (f, None) for f, s in zip(found, shape, strict=True)):
            sizes = " × ".join(map(str, tensor.shape)) or "a single number"
            raise ConfigError(f"{where} is {sizes}, expected {expected}; give {FORMATS}")
        if not torch.isfinite(tensor).all():
            raise ConfigError(f"{where} holds NaN or inf, expected finite weights; download the file again")
        # A copy, because the last bits of a product depend on memory alignment, which differs from file to file.
        return torch.empty(found).copy_(tensor.reshape(found))

    def weights(self) -> NetVladWeights:
        """Check that all tensors fit together, and return the weights."""
        chain, width = [], 3
        for name in CONVOLUTIONS:
            kernel = self.take(f"vgg.{name}.weight", None, width, 3, 3)
            width = len(kernel)
            chain.append((kernel, self.take(f"vgg.{name}.bias", width)))
        centroids = self.take("vlad.centroids", None, width)
        count = len(centroids)
        bias = self.take("vlad.assign.bias", count) if "vlad.assign.bias" in self.tensors else torch.zeros(count)
        whitening = None
        if "whiten.weight" in self.tensors:
            pca = self.take("whiten.weight", None, count * width)
            whitening = (pca, self.take("whiten.bias", len(pca)))
        scale, mean, std = self.take("input.scale", 1).item(), self.take("input.mean", 3), self.take("input.std", 3)
        assign = self.take("vlad.assign.weight", count, width)
        return NetVladWeights(chain, assign, bias, centroids, whitening, scale, mean, std)


def _read_checkpoint(path: Path) -> _TensorFile:
    """Read a state_dict of pytorch-NetVlad or OpenIBL, either wrapped or not.

    Apart from tensors, the file may contain only numpy numbers (its scores).
    """
    numbers: list[Any] = [np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.int64))]
    scalar = np.float64(0.0).__reduce__()[0]
    numbers += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    with torch.serialization.safe_globals(numbers):
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    tensors = {name: tensor for name, tensor in loaded.get("state_dict", loaded).items() if isinstance(tensor, Tensor)}
    tensors = {name.removeprefix("module."): tensor for name, tensor in tensors.items()}  # trained on several GPUs
    openibl = any(name.startswith("net_vlad.") for name in tensors)
    alias = _alias_openibl() if openibl else _alias_pytorch_netvlad("pool.module.centroids" in tensors)
    named = {ours: tensors[theirs] for ours, theirs in alias.items() if theirs in tensors}
    mean, std = (CAFFE_MEAN, CAFFE_STD) if openibl else (IMAGENET_MEAN, IMAGENET_STD)
    named |= {"input.scale": torch.ones(1), "input.mean": mean, "input.std": std}
    return _TensorFile(path, named, alias)


def _alias_pytorch_netvlad(several_gpus: bool) -> dict[str, str]:
    """Map the names used here to those of pytorch-NetVlad; Patch-NetVLAD adds the whitening."""
    module = ".module" if several_gpus else ""
    alias = _alias(f"encoder{module}.{{}}.weight", f"encoder{module}.{{}}.bias")
    alias |= {"vlad.centroids": f"pool{module}.centroids"}
    for part in ("weight", "bias"):
        alias |= {f"vlad.assign.{part}": f"pool{module}.conv.{part}", f"whiten.{part}": f"WPCA.0.{part}"}
    return alias


def _alias_openibl() -> dict[str, str]:
    """Map the names used here to those of OpenIBL; checkpoints of its training have no whitening."""
    alias = _alias("base_model.base.{}.weight", "base_model.base.{}.bias")
    alias |= {"vlad.centroids": "net_vlad.centroids", "vlad.assign.weight": "net_vlad.conv.weight"}
    return alias | {f"whiten.{part}": f"pca_layer.{part}" for part in ("weight", "bias")}


def _read_matlab(path: Path) -> _TensorFile:
    """Read the layers that hloc reads; their input is RGB in 0…255 minus the first pixel of the mean image."""
    net = loadmat(path, struct_as_record=False, squeeze_me=True, variable_names=["net"])["net"]
    tensors: dict[str, Tensor] = {}
    for i, layer in enumerate(np.ravel(net.layers)):
        for j, weights in enumerate(np.ravel(getattr(layer, "weights", ()))):
            # loadmat reverses the order of axes: [height, width, in, out], [D, K].
            array = np.asarray(weights, np.float32).T
            array = array.swapaxes(2, 3) if array.ndim == 4 else array
            tensors[f"net.layers[{i}].weights[{j}]"] = torch.tensor(array.copy())
    alias = _alias("net.layers[{}].weights[0]", "net.layers[{}].weights[1]")
    vlad, white = f"net.layers[{VLAD_LAYER}].weights", f"net.layers[{WHITEN_LAYER}].weights"
    alias |= {"vlad.assign.weight": f"{vlad}[0]", "vlad.centroids": f"{vlad}[1]"}
    alias |= {"whiten.weight": f"{white}[0]", "whiten.bias": f"{white}[1]"}
    named = {ours: tensors[theirs] for ours, theirs in alias.items() if theirs in tensors}
    if "vlad.centroids" in named:
        named["vlad.centroids"] = -named["vlad.centroids"]  # the file contains −c_k
        shape = named["vlad.centroids"].T.shape
        if "whiten.weight" in named and named["whiten.weight"][0].numel() == shape.numel():
            # Reorder from "clusters of one feature" to "features of one cluster".
            named["whiten.weight"] = named["whiten.weight"].reshape(-1, *shape).transpose(1, 2).flatten(1)
    image = np.asarray(net.meta.normalization.averageImage, np.float32)
    named["input.mean"] = torch.tensor(image.reshape(-1, image.shape[-1])[0])
    named |= {"input.scale": torch.tensor([255.0]), "input.std": torch.ones(3)}
    return _TensorFile(path, named, alias)


def _alias(weight: str, bias: str) -> dict[str, str]:
    """Map the names of the convolutions used here to the names in a file, given as patterns of the layer's number."""
    patterns = {"weight": weight, "bias": bias}.items()
    layers = list(zip(CONVOLUTIONS, LAYER_NUMBERS, strict=True))
    return {f"vgg.{name}.{part}": pattern.format(number) for part, pattern in patterns for name, number in layers}


def _reader(path: Path) -> Callable[[Path], _TensorFile]:
    """Choose the reader by the first bytes of the file."""
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
    except OSError as problem:
        raise ConfigError(f"cannot read NetVLAD weights {path}: {problem.strerror}; give {FORMATS}") from problem
    if head.startswith(b"MATLAB"):
        return _read_matlab
    if head.startswith((b"PK", b"\x80")):
        return _read_checkpoint
    raise ConfigError(f"{path}: neither PyTorch nor Matlab (found {head[:8]!r}); give {FORMATS}")
