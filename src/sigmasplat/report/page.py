"""Put a scored run onto its page, report.html: one file that can be sent, readable by somebody who was not there."""

import base64
import io
import json
import shlex
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sigmasplat.config import Config
from sigmasplat.config.text import differences
from sigmasplat.drawing.plot import DARK, LIGHT
from sigmasplat.drawing.view_panels import side_by_side
from sigmasplat.errors import RunError, SigmaSplatError
from sigmasplat.floorplan.floor_plan import FloorPlan, floor_plan
from sigmasplat.floorplan.picture import draw_floor_plan
from sigmasplat.io.runs import RunFolder
from sigmasplat.metrics.scored_view import ScoredView
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.presets import default_preset, list_presets, preset
from sigmasplat.render import FieldRenderer
from sigmasplat.report.html import Contents, build_report
from sigmasplat.report.summary import advice, summary_sentences, unsure

LOOKS = 24
"""Enough for a picture on a page; `export` looks from more places."""


def write_page(
    run: RunFolder,
    metrics: dict[str, Any],
    strips: dict[str, list[str]],
    plots: dict[str, str],
    warnings: list[str],
    plan: FloorPlan | None = None,
) -> None:
    """Write report.html from metrics and the pictures in images/; `strips` names views by kind, `plots` holds captions.

    Raises RunError if a picture cannot be read or the page not be written.
    """
    config, facts = run.config(), run.facts()
    if plan is not None:
        for theme in (LIGHT, DARK):
            run.write_image(f"plan-{theme.name}.png", draw_floor_plan(plan, theme))
        plots = plots | {"plan": "The map from above. Circles are worth another visit, the largest first."}
    contents = Contents(
        title=f"SigmaSplat · {metrics.get('source')}",
        subtitle=" · ".join([config.name, f"version {facts.get('version')}", _machine(run), str(facts.get("status"))]),
        metrics=metrics,
        strips=strips,
        plots=plots,
        config=json.dumps(config.to_dict(), indent=2),
        warnings=warnings,
        loops=run.read_loops(),
        story=summary_sentences(metrics, _machine(run)),
        advice=advice(metrics, str(run.path), _again(config, facts), config.to_dict()),
        unsure=unsure(metrics, plan),
        seconds=_seconds(run),
        picture=partial(_shown, run),
    )
    run.write_report(build_report(contents))


def plan_of(run: RunFolder, field: GaussianField, log: list[dict[str, Any]], camera: Camera) -> FloorPlan | None:
    """Draw up the plan of a run's map, looked at from its path but for lost frames; None where nothing is seen.

    log: records with their `T_world_camera`; `camera` is the source's.
    """
    config, known = run.config(), [record for record in log if not record["lost"]]
    path = Trajectory(
        np.array([record["timestamp_s"] for record in known]),
        np.array([record["T_world_camera"] for record in known]).reshape(-1, 4, 4),
    )
    seen_by = camera.prepared(config.input.width, config.input.crop_px)
    renderer = FieldRenderer(config.render, config.backend)
    try:
        return floor_plan(field, path, seen_by, most=LOOKS, renderer=renderer)
    except SigmaSplatError:
        return None


def _machine(run: RunFolder) -> str:
    made_on = run.facts().get("machine") or {}
    return f"{made_on.get('cpu')}, {made_on.get('cores')} cores"


def _again(config: Config, facts: dict[str, Any]) -> str:
    """Return the command that makes the run again: its preset, and every setting that differs from it."""
    words = ["sigmasplat", "run", str(facts.get("source_path") or "PATH")]
    if config.name not in list_presets():
        return shlex.join(words)
    if config.name != default_preset():
        words += ["--preset", config.name]
    return shlex.join(
        [*words, *(word for pair in differences(config, preset(config.name)) for word in ("--set", pair))]
    )


def _seconds(run: RunFolder) -> dict[str, float]:
    """Return the seconds of each stage; none where the run stopped before it noted them."""
    try:
        return run.read_profile()
    except RunError:
        return {}


def _shown(run: RunFolder, name: str) -> str:
    """Return a picture as the page holds it; charts keep their sharp lines."""
    return data_uri(run.path / name, lossless="view-" not in name)


QUALITY = 86


def data_uri(path: Path, lossless: bool = False) -> str:
    """Return a picture as a data: URI, WebP. Raises RunError if it cannot be read."""
    try:
        with Image.open(path) as picture:
            buffer = io.BytesIO()
            picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, lossless=lossless)
    except OSError as problem:
        raise RunError(f"cannot read picture {path}: {problem}") from problem
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


class Gallery:
    """Draw the strips of a few views of each kind into images/ and remember their names for the report."""

    def __init__(self, run: RunFolder, per_kind: int) -> None:
        """Start empty; strips of an earlier evaluation are removed, since the views may differ."""
        self.run, self.per_kind = run, per_kind
        self.strips: dict[str, list[str]] = {}
        for old in run.images.glob("view-*.png"):
            old.unlink()

    def add(self, view: ScoredView, place: str = "") -> None:
        """Draw one view; `place` says in which map it was seen if not in the final one."""
        name = f"view-{view.kind.replace(' ', '-')}{place and '-submap'}-{view.index:06d}.png"
        self.run.write_image(name, side_by_side(view))
        self.strips.setdefault(f"{view.kind} views{place}", []).append(f"images/{name}")
