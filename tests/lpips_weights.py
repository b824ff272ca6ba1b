"""Files of LPIPS weights as the public packages write them, with random numbers of the true shapes."""

from pathlib import Path

import torch
from torch import Tensor, nn

CHANNELS = (64, 192, 384, 256, 256)
TRUNK_FILE = "alexnet-owt-7be5be79.pth"


def alexnet() -> nn.Sequential:
    """Return torchvision's `alexnet().features`."""
    return nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(64, 192, kernel_size=5, padding=2), nn.ReLU(), nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, kernel_size=3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, kernel_size=3, padding=1), nn.ReLU(), nn.MaxPool2d(kernel_size=3, stride=2),
    )  # fmt: skip


def write_weights(folder: Path) -> tuple[nn.Sequential, list[Tensor]]:
    """Write both files of AlexNet with random weights, as torchvision and lpips save them; return what they hold."""
    torch.manual_seed(3)
    features = alexnet()
    for layer in features:
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight)  # features of the last layers then still differ
    folder.mkdir(parents=True, exist_ok=True)
    trunk = {f"features.{name}": tensor for name, tensor in features.state_dict().items()}
    torch.save(trunk | {"classifier.6.bias": torch.zeros(1000)}, folder / TRUNK_FILE)
    linear = [torch.rand(1, channels, 1, 1) for channels in CHANNELS]
    torch.save({f"lin{i}.model.1.weight": weight for i, weight in enumerate(linear)}, folder / "alex.pth")
    return features, linear
