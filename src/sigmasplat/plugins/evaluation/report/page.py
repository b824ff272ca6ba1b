"""Write the report of an evaluated run, report.html: one file that you can share, without scripts."""

import json
import shlex
from typing import Any

from sigmasplat.api import (
    Camera,
    Config,
    RunFolder,
    RunFrames,
    SigmaSplatError,
    Trajectory,
    default_preset,
    differences,
    is_preset,
    preset,
)
from sigmasplat.plugins.evaluation.report.advice import advice, next_commands
from sigmasplat.plugins.evaluation.report.charts import Plot
from sigmasplat.plugins.evaluation.report.html import Contents, build_report
from sigmasplat.plugins.evaluation.report.summary import verdicts
from sigmasplat.plugins.evaluation.report.view_strips import PanelFigure, panel_figure
from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan, run_floor_plan
from sigmasplat.plugins.outputs.floorplan.picture import plan_panels

LIKELY = 0.5
"""The page names valid frames whose `p_off` is larger."""


def write_page(
    run: RunFolder,
    metrics: dict[str, Any],
    strips: dict[str, list[list[PanelFigure]]],
    plots: dict[str, Plot],
    warnings: list[str],
    plan: FloorPlan | None = None,
    frames: RunFrames | None = None,
) -> None:
    """Write report.html from metrics and pictures; `strips`: panels of views by heading, `plots`: charts by name,
    `frames`: to name those whose pose is doubtful. Raises RunError if the page cannot be written."""
    config, facts = run.config(), run.facts()
    unsure = [] if frames is None else [frames.log[i]["index"] for i in frames.rows if frames.p_off[i] > LIKELY]
    found = advice(metrics, rerun_command(config, facts), config.to_dict())
    contents = Contents(
        title=f"SigmaSplat · {metrics.get('source')}",
        subtitle=" · ".join([config.name, f"version {facts.get('version')}", _machine(run), str(facts.get("status"))]),
        metrics=metrics,
        strips=strips,
        plots=plots,
        config=json.dumps(config.to_dict(), indent=2),
        warnings=warnings,
        verdicts=verdicts(metrics, unsure, found),
        commands=next_commands(str(run.path)),
        advice=found[1:],
        plan=[panel_figure(panel) for panel in plan_panels(plan)] if plan else [],
    )
    run.write_report(build_report(contents))


def report_plan(run: RunFolder, path: Trajectory, camera: Camera) -> FloorPlan | None:
    """Return the floor plan of a run, seen from its valid poses; None if no surface is visible.

    path: the valid poses; camera: that of the source.
    """
    settings = run.config().input
    try:
        return run_floor_plan(run, path, camera.prepared(settings.width, settings.crop_px))
    except SigmaSplatError:
        return None


def _machine(run: RunFolder) -> str:
    made_on = run.facts().get("machine") or {}
    return f"{made_on.get('cpu')}, {made_on.get('cores')} cores"


def rerun_command(config: Config, facts: dict[str, Any]) -> str:
    """Return the command that makes the run again: its preset, and every setting that differs from the preset."""
    words = ["sigmasplat", "run", str(facts.get("source_path") or "PATH")]
    if onto := facts.get("onto"):
        words += ["--onto", str(onto["run"])]
    if not is_preset(config.name):
        return shlex.join(words)
    if config.name != default_preset():
        words += ["--preset", config.name]
    return shlex.join(
        [*words, *(word for pair in differences(config, preset(config.name)) for word in ("--set", pair))]
    )
