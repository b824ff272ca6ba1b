"""NetVLAD on tiny random networks: against loops in numpy written from the paper, from every format and bad files."""

import itertools
import pickle
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
    assign_bias: np.ndarray
    centroids: np.ndarray  # [K, D]
    whiten: np.ndarray  # [P, K, D]
    whiten_bias: np.ndarray


def net(seed: int = 0) -> Net:
    random = np.random.default_rng(seed)

    def draw(*shape: int, scale: float = 1.0) -> np.ndarray:
        return (scale * random.normal(size=shape)).astype(np.float32)

    kernels = [draw(o, i, 3, 3, scale=0.5) for i, o in pairwise(WIDTHS)]
    biases = [draw(o, scale=0.3) for o in WIDTHS[1:]]
    return Net(kernels, biases, draw(K, D, scale=3), draw(K), draw(K, D), draw(P, K, D), draw(P, scale=0.1))


def unit(x: np.ndarray, axis: int = 0) -> np.ndarray:
    return x / np.linalg.norm(x, axis=axis, keepdims=True)


def expected(n: Net, image: np.ndarray, assign_bias: bool, whiten: bool) -> np.ndarray:
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
        score = np.exp(n.assign @ pixel + assign_bias * n.assign_bias)
        for k in range(K):
            vlad[k] += score[k] / score.sum() * (pixel - n.centroids[k])
    vlad = unit(unit(vlad, axis=1).ravel())
    return unit(n.whiten.reshape(P, -1) @ vlad + n.whiten_bias) if whiten else vlad


def picture(size: tuple[int, int] = (37, 50), seed: int = 5) -> np.ndarray:
    coarse = np.random.default_rng(seed).uniform(0, 1, (6, 7, 3))
    rows, columns = np.linspace(0, 5.99, size[0]).astype(int), np.linspace(0, 6.99, size[1]).astype(int)
    return coarse[rows][:, columns].astype(np.float32)


def described(path: Path, color: np.ndarray | None = None, width: int = 0) -> np.ndarray:
    color = picture() if color is None else color
    return NetVlad(NetVladWeights.load(path), width).describe(color, np.zeros(color.shape[:2], np.float32))


def state_dict(n: Net, module: str = "", bias: bool = False, whiten: bool = False) -> dict[str, torch.Tensor]:
    """Lay a network out as pytorch-NetVlad does; `module` in between after training on several GPUs."""
    tensors = {}
    for layer, kernel, b in zip(LAYERS, n.kernels, n.biases, strict=True):
        tensors[f"encoder{module}.{layer}.weight"], tensors[f"encoder{module}.{layer}.bias"] = kernel, b
    tensors[f"pool{module}.centroids"] = n.centroids
    tensors[f"pool{module}.conv.weight"] = n.assign[:, :, None, None]
    if bias:
        tensors[f"pool{module}.conv.bias"] = n.assign_bias
    if whiten:
        tensors |= {"WPCA.0.weight": n.whiten.reshape(P, K * D, 1, 1), "WPCA.0.bias": n.whiten_bias}
    return {name: torch.tensor(value) for name, value in tensors.items()}


def save_checkpoint(path: Path, tensors: dict[str, torch.Tensor], **others: Any) -> Path:
    torch.save({"epoch": 3, "state_dict": tensors, "parallel": False} | others, path)
    return path


def save_matlab(path: Path, n: Net, whiten: bool = True, mean_size: int = 4) -> Path:
    """Lay a network out as the published Matlab file: 13 convolutions among 30 layers, NetVLAD, …, whitening."""
    layers: list[dict[str, Any]] = [{"type": "relu"} for _ in range(35 if whiten else 32)]
    for layer, kernel, b in zip(LAYERS, n.kernels, n.biases, strict=True):
        layers[layer] = {"type": "conv", "weights": cell(kernel.transpose(2, 3, 1, 0), b[:, None])}
    layers[30] = {"type": "custom", "weights": cell(n.assign.T, -n.centroids.T)}
    if whiten:
        by_feature = n.whiten.transpose(2, 1, 0).reshape(1, 1, D * K, P)
        layers[33] = {"type": "conv", "weights": cell(by_feature, n.whiten_bias[None])}
    image = np.broadcast_to(MEAN_255, (mean_size, mean_size, 3))
    savemat(path, {"net": {"layers": cell(*layers), "meta": {"normalization": {"averageImage": image}}}})
    return path


def cell(*items: Any) -> np.ndarray:
    out = np.empty((1, len(items)), object)
    for i, item in enumerate(items):
        out[0, i] = item
    return out


def state_dict_openibl(n: Net, module: str = "", whiten: bool = True) -> dict[str, torch.Tensor]:
    """Lay a network out as OpenIBL's published file; its training adds `module.` and has no whitening."""
    tensors = {f"{module}net_vlad.centroids": n.centroids, f"{module}net_vlad.conv.weight": n.assign[:, :, None, None]}
    for layer, kernel, b in zip(LAYERS, n.kernels, n.biases, strict=True):
        tensors |= {f"{module}base_model.base.{layer}.weight": kernel, f"{module}base_model.base.{layer}.bias": b}
    if whiten:
        rows = n.whiten.reshape(len(n.whiten), -1)[:, :, None, None]
        tensors |= {f"{module}pca_layer.weight": rows, f"{module}pca_layer.bias": n.whiten_bias}
    return {name: torch.tensor(value) for name, value in tensors.items()}


def imagenet(color: np.ndarray) -> np.ndarray:
    return ((color - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).transpose(2, 0, 1)


def test_a_checkpoint_gives_the_papers_descriptor(tmp_path: Path) -> None:
    for whiten, bias, module in itertools.product([False, True], [False, True], ["", ".module"]):
        n = net()
        found = described(save_checkpoint(tmp_path / "c.pth.tar", state_dict(n, module, bias, whiten)))
        assert found.dtype == np.float32 and np.linalg.norm(found) == pytest.approx(1.0, abs=1e-6)
        np.testing.assert_allclose(found, expected(n, imagenet(picture()), bias, whiten), atol=2e-6)


def test_openibls_file_gives_the_papers_descriptor_of_255_rgb_less_the_mean(tmp_path: Path) -> None:
    n = net(4)
    image = (picture() * 255 - np.array([123.68, 116.779, 103.939])).transpose(2, 0, 1)
    torch.save(state_dict_openibl(n), tmp_path / "vgg16_netvlad.pth")
    np.testing.assert_allclose(described(tmp_path / "vgg16_netvlad.pth"), expected(n, image, False, True), atol=2e-6)
    trained = save_checkpoint(tmp_path / "model_best.pth.tar", state_dict_openibl(n, "module.", whiten=False))
    np.testing.assert_allclose(described(trained), expected(n, image, False, False), atol=2e-6)


def test_openibls_true_shapes_load(tmp_path: Path) -> None:
    """VGG16 with 64 clusters of 512 features; the whitening has 5 of the published 4096 rows, which are 0.5 GB."""
    widths = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    random = np.random.default_rng(0)

    def draw(*shape: int) -> np.ndarray:
        return 0.05 * random.standard_normal(shape, np.float32)

    kernels = [draw(o, i, 3, 3) for i, o in pairwise(widths)]
    biases = [draw(o) for o in widths[1:]]
    n = Net(kernels, biases, draw(64, 512), draw(64), draw(64, 512), draw(5, 64, 512), draw(5))
    torch.save(state_dict_openibl(n), tmp_path / "vgg16_netvlad.pth")
    weights = NetVladWeights.load(tmp_path / "vgg16_netvlad.pth")
    assert [tuple(kernel.shape) for kernel, _ in weights.convolutions] == [kernel.shape for kernel in kernels]
    assert np.array_equal(weights.centroids.numpy(), n.centroids) and np.array_equal(weights.assign.numpy(), n.assign)
    vector = NetVlad(weights).describe(picture(), np.zeros((37, 50), np.float32))
    assert vector.shape == (5,) and np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("mean_size", [1, 4])
def test_the_matlab_file_gives_the_papers_descriptor_of_255_rgb_less_the_mean(tmp_path: Path, mean_size: int) -> None:
    n = net(1)
    image = (picture() * 255 - MEAN_255).transpose(2, 0, 1)
    found = described(save_matlab(tmp_path / "net.mat", n, mean_size=mean_size))
    np.testing.assert_allclose(found, expected(n, image, False, True), atol=2e-6)
    bare = described(save_matlab(tmp_path / "bare.mat", n, whiten=False))
    np.testing.assert_allclose(bare, expected(n, image, False, False), atol=2e-6)


def test_how_a_checkpoint_is_wrapped_changes_no_bit(tmp_path: Path) -> None:
    tensors = state_dict(net(2), whiten=True)
    torch.save(tensors, tmp_path / "bare")
    torch.save({"state_dict": tensors}, tmp_path / "legacy", _use_new_zipfile_serialization=False)
    wrapped = described(save_checkpoint(tmp_path / "wrapped", tensors))
    assert np.array_equal(described(tmp_path / "bare"), wrapped)
    assert np.array_equal(described(tmp_path / "legacy"), wrapped)


def test_the_format_follows_from_the_content_not_the_name(tmp_path: Path) -> None:
    n = net()
    wrong = save_matlab(tmp_path / "net.mat", n).rename(tmp_path / "net.pth")
    assert described(wrong).shape == (P,)
    assert described(save_checkpoint(tmp_path / "net.mat", state_dict(n))).shape == (K * D,)


@pytest.mark.parametrize("core", ["core", "_core"])
def test_a_checkpoint_may_hold_its_scores_as_numpy_numbers_of_any_version(tmp_path: Path, core: str) -> None:
    scores = {"recalls": {1: np.float64(0.8), 5: np.float64(0.9)}, "best_score": np.float64(0.9)}
    path = save_checkpoint(tmp_path / "c.pth", state_dict(net()), **scores)
    old, new = b"cnumpy._core.multiarray\n", f"cnumpy.{core}.multiarray\n".encode()
    legacy = tmp_path / "legacy.pth"
    torch.save({"state_dict": state_dict(net())} | scores, legacy, _use_new_zipfile_serialization=False)
    assert old in legacy.read_bytes()
    legacy.write_bytes(legacy.read_bytes().replace(old, new))
    assert np.array_equal(described(legacy), described(path))


def test_depth_is_not_looked_at_and_the_working_width_is_kept(tmp_path: Path) -> None:
    describe = NetVlad(NetVladWeights.load(save_checkpoint(tmp_path / "c", state_dict(net())))).describe
    color = picture()
    random = np.random.default_rng(0).uniform(0, 5, color.shape[:2]).astype(np.float32)
    assert np.array_equal(describe(color, random), describe(color, np.zeros_like(random)))
    large = np.repeat(np.repeat(color, 2, 0), 2, 1)
    small = described(tmp_path / "c", large, width=50)
    assert small @ described(tmp_path / "c", color) > 0.99 > small @ described(tmp_path / "c", large)
    assert np.array_equal(described(tmp_path / "c", color, width=50), described(tmp_path / "c", color))
    with pytest.raises(ConfigError, match=r"at least 16 pixels in each direction, found 20×15; raise input\.width"):
        described(tmp_path / "c", color, width=20)


def one_line(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        NetVladWeights.load(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text


Damage = Callable[[dict[str, torch.Tensor]], None]


def put(name: str, *shape: int) -> Damage:
    return lambda tensors: tensors.__setitem__(name, torch.zeros(shape))


def test_a_checkpoint_that_does_not_fit_is_named_with_found_and_expected(tmp_path: Path) -> None:
    for damage, wanted in [
        (lambda t: t.pop("encoder.17.weight"), "encoder.17.weight is missing (expected any × 6 × 3 × 3)"),
        (lambda t: t.pop("encoder.28.bias"), "encoder.28.bias is missing (expected 4)"),
        (lambda t: t.pop("pool.centroids"), "pool.centroids is missing (expected any × 4)"),
        (lambda t: t.pop("WPCA.0.bias"), "WPCA.0.bias is missing (expected 7)"),
        (put("encoder.0.weight", 2, 3, 11, 11), "encoder.0.weight is 2 × 3 × 11 × 11, expected any × 3 × 3 × 3"),
        (put("encoder.2.weight", 4, 9, 3, 3), "encoder.2.weight is 4 × 9 × 3 × 3, expected any × 2 × 3 × 3"),
        (put("encoder.5.bias", 8), "encoder.5.bias is 8, expected 3"),
        (put("pool.conv.weight", 5, 4, 1, 1), "pool.conv.weight is 5 × 4 × 1 × 1, expected 3 × 4"),
        (put("pool.centroids", 3, 512), "pool.centroids is 3 × 512, expected any × 4"),
        (put("WPCA.0.weight", 7, 99, 1, 1), "WPCA.0.weight is 7 × 99 × 1 × 1, expected any × 12"),
        (put("pool.centroids"), "pool.centroids is a single number, expected any × 4"),
        (lambda t: t["encoder.7.bias"].fill_(np.nan), "encoder.7.bias holds NaN or inf"),
    ]:
        tensors = state_dict(net(), whiten=True)
        damage(tensors)
        text = one_line(save_checkpoint(tmp_path / "c.pth", tensors))
        assert wanted in text and ("give a pytorch-NetVlad checkpoint" in text or "download" in text)


def test_other_formats_name_their_own_keys(tmp_path: Path) -> None:
    n = net()
    n.kernels[3] = n.kernels[3][:, :2]
    wanted = "net.layers[7].weights[0] is 5 × 2 × 3 × 3, expected any × 3 × 3 × 3"
    assert wanted in one_line(save_matlab(tmp_path / "a.mat", n))


def test_a_matlab_file_of_something_else_is_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "x.mat", {"images": np.zeros(3)})
    assert "unreadable as NetVLAD weights (KeyError: 'net')" in one_line(tmp_path / "x.mat")
    savemat(tmp_path / "y.mat", {"net": {"layers": cell({"type": "conv"}, {"type": "relu"})}})
    assert "unreadable" in one_line(tmp_path / "y.mat")


def test_what_is_no_weights_file_is_refused(tmp_path: Path) -> None:
    assert "No such file" in one_line(tmp_path / "absent.pth")
    assert "Is a directory" in one_line(tmp_path)
    for name, content in (("text", b"<!DOCTYPE html> not found"), ("empty", b"")):
        (tmp_path / name).write_bytes(content)
        assert "neither PyTorch nor Matlab" in one_line(tmp_path / name)
    torch.save([1, 2, 3], tmp_path / "list")
    assert "unreadable" in one_line(tmp_path / "list")


@pytest.mark.parametrize("kind", ["checkpoint", "matlab"])
def test_a_file_cut_short_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "weights"
    save_checkpoint(path, state_dict(net()))
    if kind == "matlab":
        path = save_matlab(tmp_path / "weights.mat", net())
    path.write_bytes(path.read_bytes()[:3000])
    one_line(path)


class Payload:
    """Pickled, it would run a command on loading."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.trace,)


@pytest.mark.parametrize("zipped", [True, False])
def test_loading_runs_no_code(tmp_path: Path, zipped: bool) -> None:
    evil = {"state_dict": state_dict(net()), "optimizer": Payload(tmp_path / "ran")}
    torch.save(evil, tmp_path / "evil.pth", _use_new_zipfile_serialization=zipped)
    assert "contains more than tensors and numbers" in one_line(tmp_path / "evil.pth")
    (tmp_path / "plain.pkl").write_bytes(pickle.dumps(evil["optimizer"]))
    one_line(tmp_path / "plain.pkl")
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "evil.pth", weights_only=False)
    assert (tmp_path / "ran").exists(), "the payload must have been able to"
