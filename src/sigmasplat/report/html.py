"""Write report.html: the run in words, figures, views, path, times, advice, settings. One file, no scripts."""

import html
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sigmasplat.report import tables
from sigmasplat.report.summary import Advice
from sigmasplat.report.tables import headline

STYLE = """
:root { color-scheme: light dark; --page: #f6f7f9; --card: #ffffff; --ink: #1b1f24; --soft: #5c6670; --line: #e1e4e8;
  --accent: #c2501b; }
@media (prefers-color-scheme: dark) {
  :root { --page: #101317; --card: #181b20; --ink: #e8ebef; --soft: #99a3ad; --line: #2c3138; --accent: #ff8c46; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", "Helvetica Neue", sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 40px 24px 80px; }
h1 { font-size: 30px; line-height: 1.2; letter-spacing: -0.02em; margin: 0 0 4px; }
h2 { font-size: 20px; letter-spacing: -0.01em; margin: 48px 0 12px; }
h3 { font-size: 15px; margin: 0 0 12px; }
p { max-width: 74ch; margin: 0 0 12px; }
.soft, figcaption, th, .unit { color: var(--soft); }
.alarm { color: var(--accent); font-weight: 600; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(148px, 1fr)); gap: 12px; margin: 24px 0; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px;
  overflow-x: auto; }
.tile b { display: block; font-size: 26px; line-height: 1.25; font-weight: 620; font-variant-numeric: tabular-nums; }
.tile span { font-size: 13px; color: var(--soft); }
.tile .unit { display: inline; font-size: 15px; font-weight: 400; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 12px; align-items: start; }
table { border-collapse: collapse; width: 100%; font-size: 14.5px; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 6px 10px; border-bottom: 1px solid var(--line); font-weight: 400; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr:last-child td { border-bottom: 0; }
figure { margin: 0 0 14px; }
figure img { display: block; width: 100%; height: auto; border-radius: 10px; border: 1px solid var(--line); }
figcaption { font-size: 14px; margin-top: 6px; }
ul { max-width: 74ch; padding-left: 20px; } li { margin-bottom: 10px; }
li pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 8px 12px;
  margin-top: 4px; }
details { margin-top: 12px; } summary { cursor: pointer; }
pre { overflow-x: auto; font: 13px/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; margin: 0; }
"""


@dataclass(frozen=True)
class Contents:
    """What a report shows. Pictures are file names, of which `picture` makes what a page can show; `plots` come as
    <name>-light/-dark.png, with their captions.

    story: sentences; advice: what to try next, with a command or without; unsure: a picture of where, and sentences;
    seconds: where the time went, by stage; loops: the records of loops.json.
    """

    title: str
    subtitle: str
    metrics: dict[str, Any]
    strips: dict[str, list[str]] = field(default_factory=dict)
    plots: dict[str, str] = field(default_factory=dict)
    config: str = ""
    warnings: list[str] = field(default_factory=list)
    loops: list[dict[str, Any]] = field(default_factory=list)
    story: list[str] = field(default_factory=list)
    advice: list[Advice] = field(default_factory=list)
    unsure: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    picture: Callable[[str], str] = str


def build_report(contents: Contents) -> str:
    """Return the whole page as HTML. `metrics` is what `evaluate` returns; absent values show as a dash."""
    parts = [
        f"<h1>{html.escape(contents.title)}</h1><p class=soft>{html.escape(contents.subtitle)}</p>",
        "".join(f"<p class=alarm>{html.escape(warning)}</p>" for warning in contents.warnings),
        _story(contents.story),
        _tiles(contents.metrics),
        _unsure(contents),
        _plot(contents, "trajectory", "Trajectory"),
        _strips(contents),
        _submaps(contents),
        _tables(contents.metrics),
        _time(contents),
        _advice(contents.advice),
        _settings(contents),
    ]
    head = "<meta charset=utf-8><meta name=viewport content='width=device-width'>"
    title, body = html.escape(contents.title), "\n".join(parts)
    return (
        f"<!doctype html>\n<html lang=en>{head}<title>{title}</title><style>{STYLE}</style>\n"
        f"<main>\n{body}\n</main></html>\n"
    )


def _tiles(metrics: dict[str, Any]) -> str:
    """Show the headline figures as tiles."""
    tiles = [
        f"<div class='card tile'><b>{value} <span class=unit>{unit}</span></b><span>{html.escape(name)}</span></div>"
        for name, value, unit in headline(metrics)
    ]
    return f"<div class=tiles>{''.join(tiles)}</div>"


def _story(sentences: list[str]) -> str:
    """Say the whole run in words."""
    return f"<h2>In short</h2><p>{html.escape(' '.join(sentences))}</p>" if sentences else ""


def _unsure(contents: Contents) -> str:
    """Show where the map is unsure: what a second visit should look at."""
    if not contents.unsure:
        return ""
    words = "".join(f"<p>{html.escape(sentence)}</p>" for sentence in contents.unsure)
    return f"<h2>Where it was unsure</h2>{words}{_figure(contents, 'plan', 'Floor plan of uncertainty')}"


def _time(contents: Contents) -> str:
    """Show where the time went: by frame, and by stage in all, the final map among them."""
    if "seconds" not in contents.plots and not contents.seconds:
        return ""
    finish_s = contents.metrics.get("finish_s")
    seconds = contents.seconds | ({} if finish_s is None else {"final map": finish_s})
    whole = sum(seconds.values()) or 1.0
    largest = sorted(seconds.items(), key=lambda item: -item[1])
    rows = [[stage, tables.number(spent, 1), tables.number(spent / whole, 0, 100.0)] for stage, spent in largest]
    table = _table([["stage", "seconds", "%"], *rows]) if rows else ""
    return f"<h2>Time</h2>{_figure(contents, 'seconds', 'Time')}<div class=card>{table}</div>"


def _advice(advice: list[Advice]) -> str:
    """Say what to try next, with the commands."""
    if not advice:
        return ""
    items = [
        f"<li>{html.escape(words)}{f'<pre>{html.escape(command)}</pre>' if command else ''}</li>"
        for words, command in advice
    ]
    return f"<h2>What to try next</h2><ul>{''.join(items)}</ul>"


def _strips(contents: Contents) -> str:
    """Show the strips of each kind of view under a heading."""
    strips = contents.strips
    if not any(strips.values()):
        return ""
    explanation = (
        "<p class=soft>Rendered at the estimated poses. V is the variance of colour along each ray that the map itself "
        "predicts. Its root and the root of the squared error have a scale each: the two pictures look alike where the "
        "map knows what it does not know. Slate pixels: no depth reading, or nothing mapped.</p>"
    )
    parts = ["<h2>Views</h2>", explanation]
    for kind, names in strips.items():
        if names:
            parts.append(f"<h3>{html.escape(kind)}</h3>")
            parts += [
                f"<figure><img src='{html.escape(contents.picture(name))}' alt='view'></figure>" for name in names
            ]
    return "".join(parts)


def _plot(contents: Contents, name: str, title: str) -> str:
    """Show a plot under a heading of its own."""
    return f"<h2>{title}</h2>{_figure(contents, name, title)}" if name in contents.plots else ""


def _figure(contents: Contents, name: str, title: str) -> str:
    """Show a plot in the version that fits the reader's page."""
    if name not in contents.plots:
        return ""
    light, dark = (html.escape(contents.picture(f"images/{name}-{theme}.png")) for theme in ("light", "dark"))
    return (
        f"<figure><picture><source media='(prefers-color-scheme: dark)' srcset='{dark}'>"
        f"<img src='{light}' alt='{title}'></picture>"
        f"<figcaption>{html.escape(contents.plots[name])}</figcaption></figure>"
    )


def _tables(metrics: dict[str, Any]) -> str:
    """Show the scores of pictures, path, surface and uncertainty in full."""
    body = "".join(
        f"<div class=card><h3>{title}</h3>{_table(rows)}</div>" for title, rows in tables.cards(metrics) if rows[1:]
    )
    return f"<h2>Scores</h2><div class=pair>{body}</div>"


def _submaps(contents: Contents) -> str:
    """Show how the map was cut and which loops were closed, where there is more than one submap."""
    if (contents.metrics.get("submaps") or 1) < 2:
        return ""
    accepted = [loop for loop in contents.loops if loop.get("accepted")]
    refused = [loop for loop in contents.loops if not loop.get("accepted")]
    parts = [
        "<h2>Submaps and loops</h2>",
        f"<p class=soft>{html.escape(tables.submap_sentence(contents.metrics))}</p>",
        _figure(contents, "submaps", "Submaps and loops"),
    ]
    if accepted:
        parts.append(f"<div class=card><h3>Loops accepted</h3>{_table(tables.loop_rows(accepted))}</div>")
    if refused:
        rows = _table(tables.loop_rows(refused))
        parts.append(f"<details class=card><summary>{len(refused)} loops tried and refused</summary>{rows}</details>")
    return "".join(parts)


def _table(rows: list[list[str]]) -> str:
    """Lay out rows of text; the first is the head."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"


def _settings(contents: Contents) -> str:
    """Show the used configuration, folded."""
    if not contents.config:
        return ""
    return (
        "<h2>Settings</h2><details class=card><summary>config.json, as used</summary>"
        f"<pre>{html.escape(contents.config)}</pre></details>"
    )
