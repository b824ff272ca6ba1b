"""Compare the blend kernels with what the processor can do: arithmetic, and reads from its caches.

Counted, at random blocks of pixels: the splats that each block tests and composites, by the rules of
`native/raster_blend.h`. Timed: the two blend stages of a forward and a backward pass, with one thread, on the maps of
cpu.py. Measured for comparison: the largest rate of a matrix product, and of reading arrays in the second cache and in
memory.
Writes benchmarks/results/roofline-<machine>.json and prints a table. Do not use the machine for anything else.

example: python benchmarks/roofline.py --quick
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import torch
import tyro
from cpu import alone, default_source, supported_isas
from numpy.typing import NDArray
from scenes import Scene, make_scene
from tables import Section, significant
from works import RENDER, STAGES, Works, set_up

from sigmasplat.render import reference

arg = tyro.conf.arg
LANES = {"avx512": (16, 4, 4), "avx2": (8, 4, 2)}
"""Lanes, width and height of a block by instruction set; all others have the last."""
FOUR_LANES = (4, 2, 2)
TILE, CHUNK, FEATURES = 16, 32, 7
TESTED_FMA, TESTED_OTHER = 10, 5
"""Vector instructions for one splat that a block tests: p, q and the exponent need 5 multiply-adds, 2^t 5 more; the
others round, clamp and compare."""
FORWARD_FMA, FORWARD_OTHER = FEATURES + 1, 1
"""For one that it composites: a multiply-add for each feature and for T, and a product for the weight."""
BACKWARD_FMA, BACKWARD_OTHER = FEATURES + 2 + 16, 5
"""The same backwards: its gain, T, the gain from behind, and 16 sums over the block; differences and products."""
GEOMETRY_BYTES, ROW_BYTES = 24, 64
"""What a test reads of a splat, and what each tile copies of it."""
MATRIX, ROUNDS = 1024, 7
ARRAY_BYTES = {"cache": 256 * 1024, "memory": 256 * 1024**2}


@dataclass(frozen=True)
class Options:
    """Compare the blend kernels with the largest rates of one core."""

    source: Annotated[str, arg(help="sequence whose depth becomes splats")] = field(default_factory=default_source)
    frame: Annotated[int, arg(help="frame of the sequence")] = 150
    splats: Annotated[tuple[int, ...], arg(help="sizes of the map")] = (20_000, 77_000, 300_000)
    width: Annotated[int, arg(help="width of the image, pixels")] = 320
    isas: Annotated[tuple[str, ...], arg(help="instruction sets (default: all supported)")] = ()
    blocks: Annotated[int, arg(help="blocks of pixels at which splats are counted")] = 400
    passes: Annotated[int, arg(help="timed passes of each map")] = 15
    seed: int = 0
    quick: Annotated[bool, arg(help="one small map, no results written", help_behavior_hint="")] = False
    name: Annotated[str, arg(help="name of the results")] = "roofline"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


# ---- work ----


@dataclass(frozen=True)
class Work:
    """Mean numbers per pixel: splats its block tests, splats its block composites, and splats that it shows itself.

    copied: splats that tiles copy, per splat of the map.
    """

    tested: float
    composited: float
    contributing: float
    copied: float


@dataclass(frozen=True, eq=False)
class Footprints:
    """Splats in view, near to far: centre [N, 2] px, conic [N, 3], opacity [N], and half extents [N, 2] px."""

    means: NDArray[np.float64]
    conics: NDArray[np.float64]
    opacities: NDArray[np.float64]
    half: NDArray[np.float64]

    @staticmethod
    def of(scene: Scene) -> "Footprints":
        """Project the splats of a scene."""
        f = scene.field
        with torch.no_grad():
            p = reference.project(f.means, f.quats, f.scales, torch.eye(4), scene.camera, RENDER)
        order = np.argsort(p.z.numpy(), kind="stable")
        opacities = f.opacities.detach().double().numpy()
        order = order[(p.radii.numpy()[order, 0] > 0) & (opacities[order] > RENDER.alpha_min)]
        conics = p.conics.double().numpy()[order]
        l1, l2, l3 = conics.T
        reach = np.sqrt(2.0 * np.log(opacities[order] / RENDER.alpha_min))
        half = np.stack([np.hypot(l3, l2) / (l1 * l3), 1.0 / l3], 1) * reach[:, None]
        return Footprints(p.means2d.double().numpy()[order], conics, opacities[order], half)

    def alphas_in(self, left: int, top: int, width: int, height: int) -> NDArray[np.float64]:
        """Return α [n, pixels] of the n splats whose box touches the pixels of a block."""
        low, high = self.means - self.half, self.means + self.half
        at = (low[:, 0] <= left + width - 1) & (high[:, 0] >= left) & (low[:, 1] <= top + height - 1)
        at &= high[:, 1] >= top
        v, u = (grid.ravel() for grid in np.mgrid[top : top + height, left : left + width])
        dx, dy = u - self.means[at, :1], v - self.means[at, 1:]
        l1, l2, l3 = (self.conics[at, k : k + 1] for k in range(3))
        alpha = self.opacities[at, None] * np.exp(-0.5 * ((l1 * dx + l2 * dy) ** 2 + (l3 * dy) ** 2))
        return np.where(alpha >= RENDER.alpha_min, np.minimum(alpha, reference.ALPHA_MAX), 0.0)


def count_work(scene: Scene, block: tuple[int, int], blocks: int, random: np.random.Generator) -> Work:
    """Count what `blend` does at random blocks of (width, height) pixels."""
    splats, c, (width, height) = Footprints.of(scene), scene.camera, block
    columns, rows = c.width // width, c.height // height
    drawn = random.permutation(columns * rows)[:blocks]
    found = [_work_in(splats.alphas_in(i % columns * width, i // columns * height, width, height)) for i in drawn]
    size = np.array([c.width - 1, c.height - 1])
    low, high = ((splats.means + sign * splats.half).clip(0, size) // TILE for sign in (-1, 1))
    copies = (high - low + 1).prod(1).sum()
    return Work(*np.mean(found, 0).tolist(), float(copies) / len(scene.field))


def _work_in(alpha: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the splats that a block tests and composites, and the mean number that its pixels show."""
    light = np.cumprod(np.concatenate([np.ones((1, alpha.shape[1])), 1.0 - alpha]), 0)[:-1]
    live = light >= RENDER.transmittance_stop
    begun = live[::CHUNK].any(1)  # a block that has no live pixel at the end of a chunk stops there
    tested = min(int(begun.sum()) * CHUNK, len(alpha))
    shown = (alpha > 0) & live
    at_start = np.repeat(live[::CHUNK], CHUNK, 0)[: len(alpha)]
    return tested, int(((alpha > 0) & at_start).any(1)[:tested].sum()), float(shown.sum() / alpha.shape[1])


# ---- largest rates ----


def best_s(work: Callable[[], object]) -> float:
    """Return the shortest time of a work, seconds."""
    taken = []
    for _ in range(ROUNDS + 2):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return min(taken[2:])


def largest_rates() -> dict[str, float]:
    """Measure one core: GFLOP/s of a product of matrices, and GB/s of reading arrays."""
    torch.set_num_threads(1)
    a, b = torch.rand(MATRIX, MATRIX), torch.rand(MATRIX, MATRIX)
    rates = {"gflops": 2e-9 * MATRIX**3 / best_s(lambda: torch.mm(a, b))}
    for name, size in ARRAY_BYTES.items():
        values, repeats = np.ones(size // 4, np.float32), max(1, 2**26 // size)

        def read(values: NDArray[np.float32] = values, repeats: int = repeats) -> None:
            for _ in range(repeats):
                np.dot(values, values)

        rates[name] = 1e-9 * size * repeats / best_s(read)
    return rates


# ---- measurement ----


def measure_map(options: Options, splats: int, isa: str) -> dict[str, Any]:
    """Count and time the blend stages of one map with one instruction set, in this process."""
    set_up(isa, 1)
    scene = make_scene(options.source, options.frame, splats, options.width, options.seed)
    works = Works(scene)
    works.pose_only()  # leaves the loss gradient for `backward`
    works.stages(2)
    stages = works.stages(options.passes)
    lanes, width, height = LANES.get(isa, FOUR_LANES)
    random = np.random.default_rng(options.seed)
    counted, c = count_work(scene, (width, height), options.blocks, random), scene.camera
    forward_s, backward_s = (1e-3 * stages[name] for name in (STAGES[2], STAGES[3]))
    return {
        "splats": splats, "isa": isa, "lanes": lanes, "pixels": c.width * c.height, **asdict(counted),
        "forward": _rates(counted, c.width * c.height, lanes, splats, forward_s, FORWARD_FMA, FORWARD_OTHER),
        "backward": _rates(counted, c.width * c.height, lanes, splats, backward_s, BACKWARD_FMA, BACKWARD_OTHER),
    }  # fmt: skip


def _rates(work: Work, pixels: int, lanes: int, splats: int, taken_s: float, fma: int, other: int) -> dict[str, float]:
    """Return the rates of a stage: pairs, arithmetic of all lanes, reads of the tile's own copy, and of the rows."""
    flops = work.tested * (2 * TESTED_FMA + TESTED_OTHER) + work.composited * (2 * fma + other)
    near = (work.tested * (GEOMETRY_BYTES + 4) + work.composited * (4 * FEATURES + 8 * lanes + 8)) / lanes
    return {
        "ms": 1e3 * taken_s,
        "gpairs": 1e-9 * work.contributing * pixels / taken_s,
        "gflops": 1e-9 * flops * pixels / taken_s,
        "near_gb": 1e-9 * near * pixels / taken_s,
        "far_gb": 1e-9 * work.copied * splats * ROW_BYTES / taken_s,
    }


def measure(options: Options) -> dict[str, Any]:
    """Measure the largest rates and every map, each in a process of its own."""
    maps = sorted(options.splats)[: 1 if options.quick else None]
    isas = [isa for isa in options.isas or supported_isas() if isa in LANES]
    return {
        "largest": alone(largest_rates),
        "maps": [alone(measure_map, options, splats, isa) for isa in isas for splats in maps],
    }


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the work of a pixel, the rates of the stages, and the largest rates."""
    figures = measured["figures"]
    largest, maps = figures["largest"], figures["maps"]
    work = [
        [f"{m['splats']}, {m['isa']}", *(significant(m[name]) for name in ("tested", "composited", "contributing")),
         f"{100 * m['contributing'] / m['tested']:.0f}"]
        for m in maps
    ]  # fmt: skip
    rows = [
        [f"{m['splats']}, {m['isa']}, {stage}", significant(m[stage]["ms"]), significant(m[stage]["gpairs"]),
         significant(m[stage]["gflops"]), f"{100 * m[stage]['gflops'] / largest['gflops']:.0f}",
         significant(m[stage]["near_gb"]), f"{100 * m[stage]['near_gb'] / largest['cache']:.0f}",
         significant(m[stage]["far_gb"])]
        for m in maps for stage in ("forward", "backward")
    ]  # fmt: skip
    best = [[significant(largest[name]) for name in ("gflops", *ARRAY_BYTES)]]
    return [
        Section("Work of a pixel", WORK, work, "Pairs: splats that the pixel shows, of those that its block tests."),
        Section("Rates of one core", RATES, rows, NOTE),
        Section("Largest rates of one core", LARGEST, best),
    ]


WORK = ("splats, instructions", "tested", "composited", "shown", "pairs, %")
RATES = (
    "splats, instructions, stage", "ms", "G pairs/s", "GFLOP/s", "of the largest, %", "reads, GB/s",
    "of the largest, %", "rows copied, GB/s",
)  # fmt: skip
LARGEST = ("product of matrices, GFLOP/s", "second cache, GB/s", "memory, GB/s")
NOTE = (
    "GFLOP/s: of all lanes, also of those whose result is not used; a multiply-add is two. Reads: from the tile's copy "
    "of its splats, which fits in the first cache, relative to the second cache. Rows copied: from memory to the tiles."
)


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("roofline", options, measure, [options.seed], not options.quick)


if __name__ == "__main__":
    program.start(main, Options)
