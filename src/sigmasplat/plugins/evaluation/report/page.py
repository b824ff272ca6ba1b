"""Write the report of an evaluated run, report.html: one file that you can share, without scripts.

It begins with a picture of the map, three verdicts and the next commands; the rest is folded.
"""

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sigmasplat.api import Camera, RunFolder, RunFrames, SigmaSplatError, Trajectory, sensor_said
from sigmasplat.plugins.evaluation.failure import rerun_command
from sigmasplat.plugins.evaluation.report import tables
from sigmasplat.plugins.evaluation.report.advice import Advice, advice, next_commands
from sigmasplat.plugins.evaluation.report.charts import Plot
from sigmasplat.plugins.evaluation.report.summary import Verdict, verdicts
from sigmasplat.plugins.outputs.drawing.plot import Chart, svg
from sigmasplat.plugins.outputs.drawing.view_panels import PANEL_WIDTH, ViewPanel
from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan, run_floor_plan
from sigmasplat.plugins.outputs.floorplan.picture import plan_panels

LIKELY = 0.5
"""The page names valid frames whose `p_off` is larger."""


def write_page(
    run: RunFolder, metrics: dict[str, Any], strips: dict[str, list[list[ViewPanel]]], plots: dict[str, Plot],
    warnings: list[str], plan: FloorPlan | None = None, frames: RunFrames | None = None,
) -> None:  # fmt: skip
    """Write report.html from metrics and pictures; `strips`: panels of views by heading, `plots`: charts by name,
    `frames`: to name those whose pose is doubtful. Raises RunError if the page cannot be written."""
    config, facts = run.config(), run.facts()
    made_on = facts.get("machine") or {}
    unsure = [] if frames is None else [frames.log[i]["index"] for i in frames.rows if frames.p_off[i] > LIKELY]
    found = [(said, " ".join(commands[:1])) for said, commands in (metrics.get("alarms") or {}).items()]
    found += advice(metrics, rerun_command(config, facts), config.to_dict())
    machine, times = f"{made_on.get('cpu')}, {made_on.get('cores')} cores", sensor_said(facts)
    about = [config.name, f"version {facts.get('version')}", machine, str(facts.get("status")), times]
    page = build_report(
        f"SigmaSplat · {metrics.get('source')}", " · ".join(filter(None, about)), metrics, strips, plots,
        json.dumps(config.to_dict(), indent=2), warnings, verdicts(metrics, unsure, found),
        next_commands(str(run.path)), found[1:], plan_panels(plan) if plan else [], facts.get("origins") or {},
    )  # fmt: skip
    run.write_report(page)


def report_plan(run: RunFolder, path: Trajectory, camera: Camera) -> FloorPlan | None:
    """Return the floor plan of a run, seen from its valid poses; None if no surface is visible.

    path: the valid poses; camera: that of the source.
    """
    settings = run.config().input
    try:
        return run_floor_plan(run, path, camera.prepared(settings.width, settings.crop_px))
    except SigmaSplatError:
        return None


QUALITY, EFFORT = 86, 2
"""Quality of WebP, and the effort to compress (0 to 6; a larger one takes longer and hardly saves space)."""
PAGE_WIDTH, VIEW_PANELS = 1152, 5
"""Width of the page's text column at twice the resolution of a panel, in pixels. Number of panels of a view; fewer are
not of one view, or of its predicted errors."""

STYLE = Path(__file__).with_name("page.css").read_text(encoding="utf-8")

PLAN_CAPTION = (
    "The map from above: walls are light, objects grey, the free floor dark, floor that was not observed blue; the "
    "camera path is green."
)


Strips = Mapping[str, Sequence[Sequence[ViewPanel]]]
NONE: Mapping[str, Any] = MappingProxyType({})


def build_report(
    title: str, subtitle: str, metrics: dict[str, Any], strips: Strips = NONE, plots: Mapping[str, Plot] = NONE,
    config: str = "", warnings: Sequence[str] = (), judged: Sequence[Verdict] = (), commands: Sequence[Advice] = (),
    advice: Sequence[Advice] = (), plan: Sequence[ViewPanel] = (), origins: Mapping[str, dict[str, str]] = NONE,
) -> str:  # fmt: skip
    """Return the whole page as HTML. `metrics` is what `evaluate` returns; absent values show as a dash.

    judged: verdicts, shown first; commands: what to do with the map; advice: what else to try; strips: panels of views
    by heading; plots: charts by name; plan: panels of the floor plan; origins: of the values that decide the result.
    """
    trajectory, states = (_figure(*plots[name]) if name in plots else "" for name in ("trajectory", "states"))
    from_above = f"{_view(plan)}<p class=soft>{PLAN_CAPTION}</p>" if plan else ""
    given = [[name, o["value"], o["origin"], o["option"]] for name, o in origins.items()]
    scores = (_card(rows, name) for name, rows in tables.score_tables(metrics) if rows[1:])
    folded = {
        "What else to try": _advice(advice), "Floor plan": from_above, "Trajectory": trajectory,
        "States of the frames": states and states + _card(tables.state_rows(metrics)), "Views": _strips(strips),
        "Scores": f"<div class=pair>{''.join(scores)}</div>",
        "Given, read, measured or assumed": given and _card([["what", "value", "origin", "what changes it"], *given]),
        "Settings (config.json)": config and f"<pre>{html.escape(config)}</pre>",
    }  # fmt: skip
    parts = [
        f"<h1>{html.escape(title)}</h1><p class=soft>{html.escape(subtitle)}</p>",
        "".join(f"<p class=alarm>{html.escape(warning)}</p>" for warning in warnings),
        _map(strips) or from_above, f"<div class=judged>{''.join(map(_verdict, judged))}</div>", _advice(commands),
        *(f"<details class=part><summary><h2>{name}</h2></summary>{body}</details>" if body else ""
          for name, body in folded.items()),
    ]  # fmt: skip
    head = "<meta charset=utf-8><meta name=viewport content='width=device-width, initial-scale=1'>"
    body = "\n".join(parts)
    return (
        f"<!doctype html>\n<html lang=en>{head}<title>{html.escape(title)}</title><style>{STYLE}</style>\n"
        f"<main>\n{body}\n</main></html>\n"
    )


def _map(strips: Strips) -> str:
    """Show the map from the place of a recorded image, and that image."""
    views = next((found for found in strips.values() if found), ())
    views = [panels for panels in views if len(panels) == VIEW_PANELS] or views
    if not views:
        return ""
    recorded, *rendered = views[len(views) // 2][:2]
    shown = [(panel, "The map") for panel in rendered] + [(recorded, "The recorded image")]
    figures = (
        f"<figure><img src='{address(panel)}' alt='{words}'>"
        f"<figcaption>{words}: {html.escape(panel.caption)}</figcaption></figure>"
        for panel, words in shown
    )
    return f"<div class=map>{''.join(figures)}</div>"


def _verdict(verdict: Verdict) -> str:
    about, words, meaning, command = map(html.escape, verdict)
    shown = f"<pre>{command}</pre>" if command else ""
    return f"<div class=card><span class=soft>{about}</span><b>{words}</b><p>{meaning}</p>{shown}</div>"


def _advice(advice: Sequence[Advice]) -> str:
    if not advice:
        return ""
    items = [
        f"<li>{html.escape(words)}{f'<pre>{html.escape(command)}</pre>' if command else ''}</li>"
        for words, command in advice
    ]
    return f"<ul>{''.join(items)}</ul>"


def _strips(strips: Strips) -> str:
    """Show the views of each kind, each as a row of panels that wraps on narrow pages."""
    if not any(strips.values()):
        return ""
    parts = [
        "<p class=soft>Images are rendered at the estimated poses. The map predicts V, the variance of colour along "
        "each ray. The root of V and the RMS error have separate colour scales. Where both look alike, V predicts "
        "the error well. If the run has predicted errors, held-out views show them instead, one standard deviation "
        "in the colours of the error. Slate pixels: no depth reading, or no surface in the map.</p>"
    ]
    for kind, views in strips.items():
        if views:
            parts.append(f"<h3>{html.escape(kind)}</h3>")
            parts += map(_view, views)
    return "".join(parts)


def _view(panels: Sequence[ViewPanel]) -> str:
    """Show the panels of a view. With five of them, the image and its render are half as wide as the page."""
    large = " large" if len(panels) == VIEW_PANELS else ""
    return f"<figure class='view{large}'>{''.join(map(_panel, panels))}</figure>"


def address(panel: ViewPanel) -> str:
    """Return the picture of a panel as a data: URI, WebP.

    Pictures larger than a panel of a strip keep their size, up to `PAGE_WIDTH`.
    """
    width = min(max(PANEL_WIDTH, panel.pixels.shape[1]), PAGE_WIDTH)
    picture, buffer = panel.picture(width, round(width * panel.pixels.shape[0] / panel.pixels.shape[1])), io.BytesIO()
    picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, method=EFFORT)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def _panel(panel: ViewPanel) -> str:
    below = f"<span>{html.escape(panel.caption)}</span>" if panel.caption else ""
    if panel.bar is not None:
        low, high = (html.escape(end) for end in panel.ends)
        colours = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in panel.bar)
        ramp = f"<i style='background: linear-gradient(90deg, {colours})'></i>"
        below = f"<span class=bar>{low}{ramp}{high}</span>{below}"
    title = html.escape(panel.title)
    return f"<div>{title}<img src='{address(panel)}' alt='{title}'>{below}</div>"


def _figure(charts: Sequence[Chart], caption: str) -> str:
    """Show the charts of a plot and its caption."""
    drawn = "".join(map(svg, charts))
    return f"<figure><div class=pair>{drawn}</div><figcaption>{html.escape(caption)}</figcaption></figure>"


def _card(rows: list[list[str]], title: str = "") -> str:
    """Return a table of text; the first row is the head."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    name = f"<h3>{title}</h3>" if title else ""
    return f"<div class=card>{name}<table><tr>{head}</tr>{body}</table></div>"
