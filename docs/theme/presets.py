"""Write the tables of presets in docs/varsplat.md and docs/cgslam.md: PYTHONPATH=src python docs/theme/presets.py.

The values are those of the presets. Where each one comes from is written here. A test compares the documents with the
output of this script, and checks that no setting of a preset is left out.
"""

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DATA_SETS = {
    "varsplat": ("replica", "tum", "scannet", "scannetpp"),
    "cgslam": ("replica", "tum", "scannet"),
}
"""The columns of the tables of the papers' presets."""

# paper: its text. code: the released code, where the paper gives no value. ours: neither gives a value.
# After a semicolon, data sets whose value comes from elsewhere.
ORIGINS: dict[str, dict[str, str]] = {
    "varsplat": {
        "input.crop_px": "code", "input.min_depth_m": "code", "input.max_depth_m": "code; tum, scannet: ours",
        "render.alpha_min": "code",
        "render.near_m": "code",
        "seeding.first_uniform": "paper", "seeding.first_gradient": "paper", "seeding.first_edges": "paper",
        "seeding.later_max": "paper", "seeding.depth_error_factor": "paper",
        "seeding.min_distance_m": "paper; scannetpp: code", "seeding.shape": "paper",
        "seeding.outliers": "paper; scannetpp: code",
        "mapping.every": "paper", "mapping.iterations": "paper", "mapping.first_iterations": "paper",
        "mapping.few_steps": "paper", "mapping.weight_l1": "paper", "mapping.weight_ssim": "paper",
        "mapping.weight_depth": "paper", "mapping.weight_isotropy": "paper", "mapping.weight_nll_color": "paper",
        "mapping.weight_nll_depth": "paper", "mapping.lr_means": "paper",
        "mapping.lr_log_scales": "paper", "mapping.colors": "code", "mapping.prune_opacity": "paper",
        "tracking.iterations": "paper", "tracking.lr_rotation": "paper", "tracking.lr_translation": "paper",
        "tracking.descent": "code", "tracking.weight_color": "paper", "tracking.tau": "paper; scannet, scannetpp: code",
        "tracking.alpha_power": "paper; scannetpp: code",
        "tracking.alpha_above": "code", "tracking.outlier_factor": "code",
        "tracking.reinit_factor": "code", "tracking.exposure": "paper",
        "submaps.distance_m": "paper", "submaps.frames": "paper",
        "submaps.uncertainty_m": "ours",
        "loops.descriptor": "paper", "loops.min_similarity": "paper", "loops.min_interval": "paper; scannetpp: code",
        "loops.most": "ours", "loops.tau": "paper",
        "registration.iterations": "paper", "registration.method": "paper",
        "registration.tau": "paper; scannet, scannetpp: code",
        "final.seed_from": "paper", "final.iterations": "paper", "final.sh_degree": "paper",
        "final.schedule": "paper", "final.uncertainty": "paper",
    },
    "cgslam": {
        "input.crop_px": "code", "input.min_depth_m": "code", "input.max_depth_m": "code",
        "render.alpha_min": "code",
        "render.near_m": "code",
        "seeding.first_uniform": "paper", "seeding.first_gradient": "paper", "seeding.first_edges": "paper",
        "seeding.later_max": "paper", "seeding.depth_error_factor": "paper",
        "seeding.min_distance_m": "code", "seeding.shape": "code",
        "seeding.outliers": "code",
        "mapping.every": "paper", "mapping.iterations": "paper", "mapping.first_iterations": "code",
        "mapping.weight_l1": "paper", "mapping.weight_ssim": "paper", "mapping.weight_depth": "paper",
        "mapping.weight_alignment": "paper", "mapping.weight_isotropy": "paper",
        "mapping.weight_isotropy_ratio": "paper", "mapping.weight_moment": "paper",
        "mapping.weight_nll_color": "paper", "mapping.weight_nll_depth": "paper",
        "mapping.lr_means_first": "code", "mapping.lr_means": "code",
        "mapping.lr_log_scales": "code", "mapping.few_steps": "code",
        "mapping.lr_pose_rotation": "paper", "mapping.lr_pose_translation": "paper", "mapping.adjustment": "paper",
        "mapping.prune_opacity": "code", "mapping.window": "paper",
        "primitives.uncertain_m2": "paper",
        "primitives.densify": "paper", "primitives.split_scale_m": "code",
        "tracking.descent": "paper", "tracking.iterations": "paper", "tracking.lr_rotation": "paper",
        "tracking.lr_translation": "paper", "tracking.weight_color": "paper", "tracking.uncertainty": "paper",
        "tracking.alpha_power": "paper", "tracking.alpha_above": "code", "tracking.outlier_factor": "code",
        "tracking.reinit_factor": "ours",
        "loops.close": "paper", "loops.uncertainty": "paper", "registration.uncertainty": "paper",
        "final.iterations": "paper", "final.uncertainty": "paper",
    },
}  # fmt: skip
SCENES: dict[str, tuple[str, ...]] = {
    "varsplat": (
        "tracking.tau", "loops.tau", "registration.tau", "mapping.weight_nll_depth", "input.crop_px", "input.limit",
        "input.max_depth_m", "loops.min_interval", "registration.method", "seeding.outliers",
    ),
    "cgslam": (
        "tracking.iterations", "tracking.lr_rotation", "tracking.lr_translation", "tracking.weight_color",
        "mapping.iterations", "mapping.every", "mapping.window", "mapping.weight_l1", "mapping.weight_depth",
        "mapping.weight_alignment", "mapping.weight_moment", "mapping.lr_means_first", "mapping.lr_means",
        "mapping.lr_log_scales", "primitives.split_scale_m",
    ),
}  # fmt: skip
"""Settings that differ between the scenes of the released code: the columns of their table."""


def paper_table(system: str) -> str:
    """Return a paper's presets: a row per setting that differs between data sets, then the others by origin."""
    from sigmasplat.config.find_preset import preset

    columns = DATA_SETS[system]
    rows = [f"| setting | {' | '.join(columns)} | from |", "|---" * (len(columns) + 2) + "|"]
    same: dict[str, list[str]] = {}
    for name, origin in ORIGINS[system].items():
        values = [_value(preset(f"{system}-{column}"), name) for column in columns]
        if len(set(values)) > 1:
            rows.append(f"| `{name}` | {' | '.join(values)} | {origin} |")
        else:
            same.setdefault(origin, []).append(f"`{name}` {values[0]}")
    equal = (f"- {origin}: {', '.join(settings)}" for origin, settings in same.items())
    return "\n".join((*rows, "", "The same for all data sets:", "", *equal))


def scene_table(system: str) -> str:
    """Return the released code's scenes: a row per set of values, a column per setting; all from the code."""
    from sigmasplat.config.find_preset import preset, presets_by_scene

    prefix = f"{system}-released-"
    released = {name.removeprefix(prefix): preset(name) for name in presets_by_scene() if name.startswith(prefix)}
    values = {column: [_value(config, column) for config in released.values()] for column in SCENES[system]}
    same = [f"`{column}` {each[0]}" for column, each in values.items() if len(set(each)) == 1]
    columns = [column for column, each in values.items() if len(set(each)) > 1]
    scenes: dict[tuple[str, ...], list[str]] = {}
    for scene, row in zip(released, zip(*(values[column] for column in columns), strict=True), strict=True):
        scenes.setdefault(row, []).append(f"`{scene}`")
    rows = [f"| scenes | {' | '.join(f'`{column}`' for column in columns)} |", "|---" * (len(columns) + 1) + "|"]
    rows += (f"| {', '.join(names)} | {' | '.join(row)} |" for row, names in scenes.items())
    return "\n".join((f"In all scenes: {', '.join(same)}.", "", *rows))


def method_table(system: str) -> str:
    """Return the table of what all presets of the released code change: the setting, the paper's value, the code's."""
    from sigmasplat.config import Config
    from sigmasplat.config.find_preset import preset, presets_by_scene

    released = [preset(name) for name in presets_by_scene() if name.startswith(f"{system}-released-")]
    rows = ["| setting | paper's presets | released | from |", "|---|---|---|---|"]
    for name in changed_by_all(released, [preset(f"{system}-{column}") for column in DATA_SETS[system]], Config()):
        if name not in SCENES[system]:
            theirs = " / ".join(dict.fromkeys(_value(preset(f"{system}-{c}"), name) for c in DATA_SETS[system]))
            rows.append(f"| `{name}` | {theirs} | {_value(released[0], name)} | code |")
    return "\n".join(rows)


def changed_by_all(released: list[Any], papers: list[Any], default: Any) -> list[str]:
    """List the settings with one value in all `released` that no preset of `papers` has, in the order of `default`."""
    names = [
        f"{section}.{name}"
        for section, values in default.to_dict().items()
        if isinstance(values, dict)
        for name in values
    ]
    chosen = []
    for name in names:
        theirs, ours = ({_value(config, name) for config in configs} for configs in (papers, released))
        if len(ours) == 1 and not ours & theirs:
            chosen.append(name)
    return chosen


def fast_list(system: str) -> str:
    """Return the settings in which a system's preset for two CPU cores differs from that for TUM: both values."""
    from sigmasplat.config.find_preset import preset

    theirs, ours = preset(f"{system}-tum"), preset(f"{system}-fast")
    changed = []
    for section, values in ours.to_dict().items():
        for name in (f"{section}.{inner}" for inner in (values if isinstance(values, dict) else ())):
            if (value := _value(ours, name)) != (other := _value(theirs, name)):
                changed.append(f"`{name}` {other} → {value}")
    return ", ".join(changed)


def rewritten(text: str) -> str:
    """Return a document with its tables between <!-- presets:KIND SYSTEM --> and <!-- /presets --> made again."""
    kinds = {"paper": paper_table, "scenes": scene_table, "methods": method_table, "fast": fast_list}

    def made(found: re.Match[str]) -> str:
        return f"<!-- presets:{found[1]} {found[2]} -->\n{kinds[found[1]](found[2])}\n<!-- /presets -->"

    return re.sub(r"<!-- presets:(\w+) (\w+) -->.*?<!-- /presets -->", made, text, flags=re.DOTALL)


def _value(config: Any, name: str) -> str:
    section, _, setting = name.partition(".")
    value = getattr(getattr(config, section), setting)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT / "src"))
    for system in DATA_SETS:
        page = ROOT / "docs" / f"{system}.md"
        page.write_text(rewritten(page.read_text(encoding="utf-8")), encoding="utf-8")
