"""Time a mapping iteration with and without an additional loss term, which autograd computes beside the CPU kernels.

Both are timed in turns. Prints milliseconds and their ratio.

example: python benchmarks/own_term.py --threads 2
"""

from dataclasses import dataclass, field
from statistics import median
from typing import Annotated

import numpy as np
import tyro
from cpu import default_source
from scenes import make_scene
from torch import Tensor
from works import Works

from sigmasplat.config import MappingConfig
from sigmasplat.fit.losses import mean_over, term
from sigmasplat.native import _core

arg = tyro.conf.arg


@term
def charbonnier(color: Tensor, color_target: Tensor, valid: Tensor) -> Tensor:
    """Return the mean of √(r² + 10⁻⁶) of the colour residual over valid pixels (the term of docs/recipes.md)."""
    return mean_over(((color - color_target) ** 2 + 1e-6).sqrt(), valid)


@dataclass(frozen=True)
class OwnMapping(MappingConfig):
    """The settings of mapping with the weight of one more term."""

    weight_charbonnier: float = 0.0


@dataclass(frozen=True)
class Options:
    """Time a mapping iteration with and without a loss term of one's own."""

    source: Annotated[str, arg(help="sequence whose depth becomes splats")] = field(default_factory=default_source)
    frame: Annotated[int, arg(help="frame of it")] = 150
    splats: Annotated[int, arg(help="size of the map")] = 77_000
    width: Annotated[int, arg(help="width of the image, pixels")] = 320
    threads: Annotated[int, arg(help="threads of the kernels; 0 = all cores")] = 0
    rounds: Annotated[int, arg(help="turns of each")] = 5
    iterations: Annotated[int, arg(help="mapping iterations in a turn, of which the least counts")] = 30


def main(options: Options) -> float:
    """Print the times; return how many times slower an iteration is with the term."""
    if options.threads:
        _core.set_threads(options.threads)
    works = Works(make_scene(options.source, options.frame, options.splats, options.width))
    plain = vars(works.mapping)
    found: dict[float, list[float]] = {0.0: [], 0.1: []}
    for _ in range(options.rounds):
        for weight, seconds in found.items():
            works.mapping = OwnMapping(**plain, weight_charbonnier=weight)
            seconds.append(min(works.mapping_iterations(options.iterations)))
    fused, own = (1e3 * median(seconds) for seconds in found.values())
    print(f"{fused:.1f} ms a mapping iteration, {own:.1f} ms with a term of one's own: {own / fused:.2f} times")
    return float(np.round(own / fused, 2))


if __name__ == "__main__":
    main(tyro.cli(Options))
