"""LPIPS on random weights of the true shapes: layer by layer against networks of torch.nn, and bad files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lpips_weights import TRUNK_FILE, write_weights
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips, find_lpips

TAPS = (1, 4, 7, 9, 11)
"""Numbers of the ReLUs whose outputs the public package compares."""


def images(height: int = 70, width: int = 93) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    image = random.uniform(size=(height, width, 3)).astype(np.float32)
    return image, np.clip(image + random.normal(0, 0.1, image.shape), 0, 1).astype(np.float32)


def by_layers(features: nn.Sequential, linear: list[Tensor], a: np.ndarray, b: np.ndarray) -> list[float]:
    """Compute each layer's distance as the public package does, in float64."""
    kept: list[list[Tensor]] = []
    for image in (a, b):
        x = torch.from_numpy(image).double().permute(2, 0, 1)[None] * 2 - 1
        x = (x - torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)) / torch.tensor([0.458, 0.448, 0.45]).view(
            1, 3, 1, 1
        )
        kept.append([])
        for number, layer in enumerate(features.double()):
            x = layer(x)
            if number in TAPS:
                kept[-1].append(x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10))
    return [
        nn.functional.conv2d((x - y) ** 2, weight.double()).mean().item()
        for x, y, weight in zip(*kept, linear, strict=True)
    ]


def test_the_sum_over_layers_equals_plain_torch(tmp_path: Path) -> None:
    features, linear = write_weights(tmp_path)
    a, b = images()
    with torch.inference_mode():
        expected = by_layers(features, linear, a, b)
    lpips = Lpips.load(tmp_path)
    assert lpips.distance(a, b) == pytest.approx(sum(expected), rel=1e-4) and lpips.distance(a, a) == 0.0


def test_files_may_be_in_a_folder_of_the_network(tmp_path: Path) -> None:
    write_weights(tmp_path / "alex")
    found, problem = find_lpips(tmp_path)
    assert found is not None and found.net == "alex" and not problem


def test_an_image_without_features_has_no_distance(tmp_path: Path) -> None:
    write_weights(tmp_path)
    lpips = Lpips.load(tmp_path)
    assert np.isnan(lpips.distance(*images(30, 80))) and np.isfinite(lpips.distance(*images(31, 31)))


def test_a_missing_file_is_named_with_the_command_that_downloads_it(tmp_path: Path) -> None:
    found, problem = find_lpips(tmp_path)
    assert found is None and "alex.pth" in problem and "sigmasplat download lpips alex" in problem
    write_weights(tmp_path)
    (tmp_path / TRUNK_FILE).unlink()
    assert "alexnet-owt-*.pth" in find_lpips(tmp_path)[1]
    with pytest.raises(ConfigError, match="alexnet-owt"):
        Lpips.load(tmp_path)


def test_wrong_files_are_refused_with_the_tensor(tmp_path: Path) -> None:
    write_weights(tmp_path)
    trunk = torch.load(tmp_path / TRUNK_FILE)
    for change, words in (
        ({"features.3.weight": torch.zeros(192, 64, 3, 3)}, r"size mismatch for 3\.weight"),
        ({"features.10.bias": torch.full((256,), torch.nan)}, "holds NaN"),
        ({"features.0.bias": None}, r"Missing key.*0\.bias"),
    ):
        changed = {name: tensor for name, tensor in (trunk | change).items() if tensor is not None}
        torch.save(changed, tmp_path / TRUNK_FILE)
        with pytest.raises(ConfigError, match=words):
            Lpips.load(tmp_path)
    for content in (b"", b"not a file of torch", b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R."):
        (tmp_path / TRUNK_FILE).write_bytes(content)
        with pytest.raises(ConfigError, match=TRUNK_FILE):
            Lpips.load(tmp_path)
    torch.save([torch.zeros(3)], tmp_path / TRUNK_FILE)
    with pytest.raises(ConfigError, match="unreadable as weights"):
        find_lpips(tmp_path)
