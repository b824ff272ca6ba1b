"""Write the report of an evaluated run, report.html: one file that you can share, without scripts."""

import json
import shlex
from collections.abc import Mapping
from typing import Any

from sigmasplat.api import (
    Camera,
    Config,
    RunError,
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
from sigmasplat.plugins.evaluation.report.html import Contents, build_report
from sigmasplat.plugins.evaluation.report.summary import rescan_sentences, summary_sentences, verdicts
from sigmasplat.plugins.evaluation.report.view_strips import PanelFigure, file_data_uri
from sigmasplat.plugins.outputs.drawing import plot
from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan, run_floor_plan
from sigmasplat.plugins.outputs.floorplan.picture import draw_floor_plan, draw_narrow_floor_plan

LIKELY = 0.5
"""The page names valid frames whose `p_off` is larger."""
SECONDS_SIZE = (plot.SIZE[0], 300)


def write_page(
    run: RunFolder,
    metrics: dict[str, Any],
    strips: dict[str, list[list[PanelFigure]]],
    plots: dict[str, str],
    warnings: list[str],
    plan: FloorPlan | None = None,
    frames: RunFrames | None = None,
) -> None:
    """Write report.html from metrics and pictures; `strips`: panels of views by heading, `plots`: captions by name,
    `frames`: to name those whose pose is doubtful.

    Raises RunError if a picture cannot be read or the page cannot be written.
    """
    config, facts = run.config(), run.facts()
    if plan is not None:
        _write_plan(run, plan)
        plots = plots | {"plan": "The map from above. Numbered circles are regions to scan again, the largest first."}
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
        loops=run.read_loops(),
        summary=summary_sentences(metrics, _machine(run)),
        verdicts=verdicts(metrics, unsure, found),
        commands=next_commands(str(run.path)),
        advice=found[1:],
        rescan=rescan_sentences(metrics, plan),
        regions=plan.regions if plan else (),
        seconds=_seconds(run),
        picture=lambda name: file_data_uri(run.path / name),
    )
    run.write_report(build_report(contents))


def write_charts(run: RunFolder, charts: Mapping[str, tuple[list[plot.Chart], str]]) -> dict[str, str]:
    """Draw charts into images/, wide and narrow, light and dark; return their captions by name."""
    for name, (drawn, _) in charts.items():
        for theme in (plot.LIGHT, plot.DARK):
            size = SECONDS_SIZE if name == "seconds" else plot.SIZE
            run.write_image(f"{name}-{theme.name}.png", plot.draw_charts(drawn, theme, size))
            run.write_image(f"{name}-narrow-{theme.name}.png", plot.draw_narrow_charts(drawn, theme))
    return {name: caption for name, (_, caption) in charts.items()}


def _write_plan(run: RunFolder, plan: FloorPlan) -> None:
    """Draw the floor plan into images/, wide and narrow, light and dark. The page lists the regions as text."""
    for theme in (plot.LIGHT, plot.DARK):
        run.write_image(f"plan-{theme.name}.png", draw_floor_plan(plan, theme, list_regions=False))
        run.write_image(f"plan-narrow-{theme.name}.png", draw_narrow_floor_plan(plan, theme))


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


def _seconds(run: RunFolder) -> dict[str, float]:
    """Return the seconds of each stage; empty if the run stopped before it wrote them."""
    try:
        return run.read_profile()
    except RunError:
        return {}
