"""Presets of CG-SLAM.

`cgslam-*` follow the paper (ECCV 2024, arXiv 2403.16095), `cgslam-light-*` are its half-resolution variant.
`cgslam-loops-*` add the submaps, loops and final map of VarSplat to the paper's settings. `cgslam-fast` and
`cgslam-loops-fast` are ours, sized for two CPU cores. The values are in `values/cgslam.toml`; where each comes from:
docs/paper-values.md.
"""

import dataclasses

from sigmasplat.api import Config
from sigmasplat.plugins.presets import varsplat
from sigmasplat.plugins.presets.shared_by_papers import fixed, made, read_values

TABLES = read_values("values/cgslam")
PAPER = made(TABLES, "paper")
"""The settings that all data sets share."""


def sized(config: Config, extent: float, first: float = 3e-4, last: float = 2.5e-4, log_scales: float = 1e-4) -> Config:
    """Set the values that the code gives in units of the scene's extent: rates of means and scales, sizes of splats."""
    return config.changed(
        mapping={"lr_means_first": first * extent, "lr_means": last * extent, "lr_log_scales": log_scales * extent},
        primitives={"split_scale_m": 0.01 * extent},
    )


DATASETS = {name: sized(made(TABLES, name), table["extent"]) for name, table in TABLES.items() if "extent" in table}
# Half of 1200 and of 640. The images are cropped afterwards by as many pixels as before, as in the code for TUM.
LIGHT_WIDTHS = {"replica": 600, "tum": 320, "scannet": 320}


def _with_loops(config: Config, like: Config) -> Config:
    """Return settings with submaps, loops, registration and final map of a VarSplat preset, without weights of V."""
    plain = varsplat.without_variance(like)
    return dataclasses.replace(
        config, submaps=like.submaps, loops=plain.loops, registration=plain.registration, final=plain.final
    )


FAST = dataclasses.replace(
    varsplat.without_variance(varsplat.DATASETS["fast"]).changed(**TABLES["fast"]),
    submaps=PAPER.submaps, loops=PAPER.loops, registration=PAPER.registration, final=PAPER.final,
)  # fmt: skip

PLUGIN = (
    *(fixed(f"cgslam-{name}", config) for name, config in DATASETS.items()),
    *(
        fixed(f"cgslam-light-{name}", config.changed(input={"width": LIGHT_WIDTHS[name]}))
        for name, config in DATASETS.items()
    ),
    *(fixed(f"cgslam-loops-{name}", _with_loops(config, varsplat.DATASETS[name])) for name, config in DATASETS.items()),
    fixed("cgslam-fast", FAST),
    fixed("cgslam-loops-fast", _with_loops(FAST, varsplat.DATASETS["fast"])),
)
