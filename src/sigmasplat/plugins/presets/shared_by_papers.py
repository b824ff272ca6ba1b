"""The settings that the papers' presets build on: those in which the papers differ from our defaults, as values."""

from sigmasplat.api import Config, Preset

BASE_VALUES: dict[str, dict[str, object]] = {
    "input": {"width": 0, "denoise_depth": False},
    "render": {"depth": "center"},
    "seeding": {
        "first_uniform": 100_000,
        "first_gradient": 50_000,
        "first_edges": True,
        "later_max": 30_000,
        "depth_error_least_m": 0.0,
        "shape": "neighbours",
        "max_splats": 0,
    },
    "mapping": {
        "every": 1,
        "overlap_below": 0.0,
        "iterations": 100,
        "first_iterations": 100,
        "divided": False,
        "few_steps": False,
        "weight_depth": 1.0,
        "weight_mean_depth": 0.0,
        "weight_moment": 0.0,
        "weight_nll_color": 0.0001,
        "lr_means": 0.0001,
        "lr_log_scales": 0.005,
        "prune_opacity": 0.5,
    },
    "primitives": {"uncertain_m2": 0.0, "split_radius_px": 0.0},
    "tracking": {
        "method": "adam",
        "align_weight_color": 0.5,
        "uncertainty": True,
        "tau": 50.0,
        "features": False,
        "verify": False,
    },
    "recovery": {"relocalise": False},
    "moving": {"find": False},
    "submaps": {"distance_m": 0.0, "uncertainty_m": 0.0, "inherit": False},
    "loops": {"near_m": 0.0, "most": 4},
    "registration": {"iterations": 100, "method": "paper", "tau": 50.0},
    "final": {"iterations": 0, "move_poses": False, "schedule": "steady", "sh_degree": 0},
    "surface": {"depth": "map"},
    "uncertainty": {"probes": 0},
}
"""What is ours alone is off, and a value that both papers share is theirs; the presets name the rest."""

BASE = Config().changed(**BASE_VALUES)


def fixed(name: str, config: Config) -> Preset:
    """Return the row of a preset whose settings are known."""
    return Preset(name, lambda: config)
