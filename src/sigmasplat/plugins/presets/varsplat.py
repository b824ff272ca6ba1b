"""Presets of VarSplat and LoopSplat: what the text says; the released code is in `released_code`.

`varsplat-*` follow the paper (arXiv 2603.09673) and its supplement. `loopsplat-*` are the same without any
uncertainty weight, which is the front end of LoopSplat (arXiv 2408.10154). `*-fast` are ours, sized for two CPU cores.
The values are in `values/varsplat.toml`; where each one comes from: docs/paper-values.md.
"""

from sigmasplat.api import Config
from sigmasplat.plugins.presets.shared_by_papers import fixed, made, read_values

TABLES = read_values("values/varsplat")
DATASETS = {name: made(TABLES, name) for name in TABLES if name != "paper"}


def without_variance(config: Config) -> Config:
    """Return the settings without any use of V and without the likelihoods that train σ²."""
    off = {"uncertainty": False}
    return config.changed(
        tracking=off, loops=off, registration=off, final=off,
        mapping={"weight_nll_color": 0.0, "weight_nll_depth": 0.0}, submaps={"uncertainty_m": 0.0},
    )  # fmt: skip


PLUGIN = (
    *(fixed(f"varsplat-{name}", config) for name, config in DATASETS.items()),
    *(fixed(f"loopsplat-{name}", without_variance(config)) for name, config in DATASETS.items()),
)
