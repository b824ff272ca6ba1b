"""NetVLAD on tiny random networks: against loops in numpy written from the paper, and from bad files."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat

from sigmasplat.errors import ConfigError
from sigmasplat.graph.netvlad import NetVlad, NetVladWeights

WIDTHS = (3, 2, 4, 3, 5, 4, 3, 6, 5, 2, 4, 3, 5, 4)  # channels before and after each of the 13 convolutions
D, K, P = WIDTHS[-1], 3, 7
LAYERS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
MEAN_255 = np.array([120.0, 110.0, 95.0], np.float32)


@dataclass
class Net:
    """The numbers of a network, none of them in any file's layout. whiten acts on clusters × features."""

    kernels: list[np.ndarray]  # [out, in, 3, 3]
    biases: list[np.ndarray]
    assign: np.ndarray  # [K, D]
    centroids: np.ndarray  # [K, D]
    whiten: np.ndarray  # [P, K, D]
    whiten_bias: np.ndarray


def net(seed: int = 0) -> Net:
    random = np.random.default_rng(seed)

    def draw(*shape: int, scale: float = 1.0) -> np.ndarray:
        return (scale * random.normal(size=shape)).astype(np.float32)

    kernels = [draw(o, i, 3, 3, scale=0.5) for i, o in pairwise(WIDTHS)]
    biases = [draw(o, scale=0.3) for o in WIDTHS[1:]]
    return Net(kernels, biases, draw(K, D, scale=3), draw(K, D), draw(P, K, D), draw(P, scale=0.1))


def unit(x: np.ndarray, axis: int = 0) -> np.ndarray:
    return x / np.linalg.norm(x, axis=axis, keepdims=True)


def expected(n: Net, image: np.ndarray, whiten: bool) -> np.ndarray:
    """Arandjelović et al. 2016 by loops; image [3, H, W] as the network wants it."""
    x = image.astype(np.float64)
    for layer, (kernel, bias) in enumerate(zip(n.kernels, n.biases, strict=True)):
        if layer in (2, 4, 7, 10):  # conv2_1, conv3_1, conv4_1, conv5_1
            h, w = x.shape[1] // 2, x.shape[2] // 2
            x = x[:, : 2 * h, : 2 * w].reshape(len(x), h, 2, w, 2).max((2, 4))
        padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
        x = sum(
            np.einsum("oi,ihw->ohw", kernel[:, :, a, b], padded[:, a : a + x.shape[1], b : b + x.shape[2]])
            for a in range(3)
            for b in range(3)
        )
        x = x + bias[:, None, None]
        if layer < 12:
            x = np.maximum(x, 0)
    vlad = np.zeros((K, D))
    for pixel in x.reshape(D, -1).T:
        pixel = unit(pixel)
        score = np.exp(n.assign @ pixel)
        for k in range(K):
            vlad[k] += score[k] / score.sum() * (pixel - n.centroids[k])
    vlad = unit(unit(vlad, axis=1).ravel())
    return unit(n.whiten.reshape(P, -1) @ vlad + n.whiten_bias) if whiten else vlad


def picture(size: tuple[int, int] = (37, 50), seed: int = 5) -> np.ndarray:
    coarse = np.random.default_rng(seed).uniform(0, 1, (6, 7, 3))
    rows, columns = np.linspace(0, 5.99, size[0]).astype(int), np.linspace(0, 6.99, size[1]).astype(int)
    return coarse[rows][:, columns].astype(np.float32)


def described(path: Path, color: np.ndarray | None = None) -> np.ndarray:
    color = picture() if color is None else color
    return NetVlad(NetVladWeights.load(path)).describe(color, np.zeros(color.shape[:2], np.float32))


def save_matlab(path: Path, n: Net, whiten: bool = True, mean_size: int = 4, without: int = -1) -> Path:
    """Lay a network out as the published Matlab file: 13 convolutions among 30 layers, NetVLAD, …, whitening."""
    layers: list[dict[str, Any]] = [{"type": "relu"} for _ in range(35 if whiten else 32)]
    for layer, kernel, b in zip(LAYERS, n.kernels, n.biases, strict=True):
        layers[layer] = {"type": "conv", "weights": cell(kernel.transpose(2, 3, 1, 0), b[:, None])}
    layers[30] = {"type": "custom", "weights": cell(n.assign.T, -n.centroids.T)}
    if whiten:
        by_feature = n.whiten.transpose(2, 1, 0).reshape(1, 1, -1, len(n.whiten))
        layers[33] = {"type": "conv", "weights": cell(by_feature, n.whiten_bias[None])}
    if without >= 0:
        layers[without] = {"type": "relu"}
    image = np.broadcast_to(MEAN_255, (mean_size, mean_size, 3))
    savemat(path, {"net": {"layers": cell(*layers), "meta": {"normalization": {"averageImage": image}}}})
    return path


def cell(*items: Any) -> np.ndarray:
    out = np.empty((1, len(items)), object)
    for i, item in enumerate(items):
        out[0, i] = item
    return out


@pytest.mark.parametrize("mean_size", [1, 4])
def test_the_matlab_file_gives_the_papers_descriptor_of_255_rgb_less_the_mean(tmp_path: Path, mean_size: int) -> None:
    n = net(1)
    image = (picture() * 255 - MEAN_255).transpose(2, 0, 1)
    found = described(save_matlab(tmp_path / "net.mat", n, mean_size=mean_size))
    np.testing.assert_allclose(found, expected(n, image, True), atol=2e-6)
    bare = described(save_matlab(tmp_path / "bare.mat", n, whiten=False))
    np.testing.assert_allclose(bare, expected(n, image, False), atol=2e-6)


def test_the_true_shapes_load(tmp_path: Path) -> None:
    """VGG16 with 64 clusters of 512 features; the whitening has 5 of the published 4096 rows, which are 0.5 GB."""
    widths = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    random = np.random.default_rng(0)

    def draw(*shape: int) -> np.ndarray:
        return 0.05 * random.standard_normal(shape, np.float32)

    kernels = [draw(o, i, 3, 3) for i, o in pairwise(widths)]
    biases = [draw(o) for o in widths[1:]]
    n = Net(kernels, biases, draw(64, 512), draw(64, 512), draw(5, 64, 512), draw(5))
    weights = NetVladWeights.load(save_matlab(tmp_path / "net.mat", n))
    assert all(
        np.array_equal(ours.numpy(), kernel) for (ours, _), kernel in zip(weights.convolutions, kernels, strict=True)
    )
    assert np.array_equal(weights.centroids.numpy(), n.centroids) and np.array_equal(weights.assign.numpy(), n.assign)
    assert weights.whitening is not None and np.array_equal(weights.whitening[0].numpy(), n.whiten.reshape(5, -1))
    vector = NetVlad(weights).describe(picture(), np.zeros((37, 50), np.float32))
    assert vector.shape == (5,) and np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-6)


def test_the_format_follows_from_the_content_not_the_name(tmp_path: Path) -> None:
    wrong = save_matlab(tmp_path / "net.mat", net()).rename(tmp_path / "net.pth")
    assert described(wrong).shape == (P,)


def test_depth_is_not_looked_at_and_a_small_image_is_refused(tmp_path: Path) -> None:
    describe = NetVlad(NetVladWeights.load(save_matlab(tmp_path / "c.mat", net()))).describe
    color = picture()
    random = np.random.default_rng(0).uniform(0, 5, color.shape[:2]).astype(np.float32)
    assert np.array_equal(describe(color, random), describe(color, np.zeros_like(random)))
    with pytest.raises(ConfigError, match=r"at least 16 pixels in each direction, found 20×15; raise input\.width"):
        described(tmp_path / "c.mat", color[:15, :20])


def one_line(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        NetVladWeights.load(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


Damage = Callable[[Net], object]


def kernel(layer: int, *shape: int) -> Damage:
    return lambda n: n.kernels.__setitem__(layer, np.zeros(shape, np.float32))


def short(name: str, *shape: int) -> Damage:
    return lambda n: setattr(n, name, np.zeros(shape, np.float32))


def test_a_file_that_does_not_fit_is_named_with_found_and_expected(tmp_path: Path) -> None:
    at = "net.layers[{}].weights[{}]".format
    damages: list[tuple[Damage, str]] = [
        (kernel(0, 2, 3, 11, 11), f"{at(0, 0)} is 2 × 3 × 11 × 11, expected any × 3 × 3 × 3"),
        (kernel(1, 4, 9, 3, 3), f"{at(2, 0)} is 4 × 9 × 3 × 3, expected any × 2 × 3 × 3"),
        (kernel(3, 5, 2, 3, 3), f"{at(7, 0)} is 5 × 2 × 3 × 3, expected any × 3 × 3 × 3"),
        (lambda n: n.biases.__setitem__(2, np.zeros(8)), f"{at(5, 1)} is 8, expected 3"),
        (short("assign", 5, 4), f"{at(30, 0)} is 5 × 4, expected 3 × 4"),
        (short("centroids", 3, 512), f"{at(30, 1)} is 3 × 512, expected any × 4"),
        (short("centroids"), f"{at(30, 1)} is a single number, expected any × 4"),
        (short("whiten", 7, 33, 3), f"{at(33, 0)} is 7 × 99, expected any × 12"),
        (short("whiten_bias", 8), f"{at(33, 1)} is 8, expected 7"),
        (lambda n: n.biases[3].fill(np.nan), f"{at(7, 1)} holds NaN or inf"),
    ]  # fmt: skip
    for damage, wanted in damages:
        n = net()
        damage(n)
        text = one_line(save_matlab(tmp_path / "c.mat", n))
        assert wanted in text and ("give hloc's VGG16-NetVLAD-Pitts30K.mat" in text or "download" in text)


@pytest.mark.parametrize("layer", [17, 30])
def test_a_missing_layer_is_named(tmp_path: Path, layer: int) -> None:
    assert f"net.layers[{layer}].weights" in (text := one_line(save_matlab(tmp_path / "c.mat", net(), without=layer)))
    assert "is missing (expected any × " in text


def test_a_matlab_file_of_something_else_is_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "x.mat", {"images": np.zeros(3)})
    assert "unreadable as NetVLAD weights (KeyError: 'net')" in one_line(tmp_path / "x.mat")
    savemat(tmp_path / "y.mat", {"net": {"layers": cell({"type": "conv"}, {"type": "relu"})}})
    assert "unreadable" in one_line(tmp_path / "y.mat")


def test_what_is_no_weights_file_is_refused(tmp_path: Path) -> None:
    assert "No such file" in one_line(tmp_path / "absent.mat")
    assert "Is a directory" in one_line(tmp_path)
    for name, content in (("text", b"<!DOCTYPE html> not found"), ("empty", b"")):
        (tmp_path / name).write_bytes(content)
        assert "it is no Matlab file" in one_line(tmp_path / name)
    torch.save([1, 2, 3], tmp_path / "checkpoint.pth")
    assert "it is no Matlab file" in one_line(tmp_path / "checkpoint.pth")


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = save_matlab(tmp_path / "weights.mat", net())
    path.write_bytes(path.read_bytes()[:3000])
    one_line(path)
