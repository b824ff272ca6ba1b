"""Write report.html: figures, strips of views, path, times, settings. One file, no scripts, pictures beside it."""

import html
import math
from dataclasses import dataclass, field
from typing import Any

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
.card { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
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
details { margin-top: 12px; } summary { cursor: pointer; }
pre { overflow-x: auto; font: 13px/1.5 ui-monospace, "SF Mono", Menlo, Consolas, monospace; margin: 0; }
"""


@dataclass(frozen=True)
class Contents:
    """What a report shows. Pictures are file names relative to report.html; `plots` come as <name>-light/-dark.png."""

    title: str
    subtitle: str
    metrics: dict[str, Any]
    strips: dict[str, list[str]] = field(default_factory=dict)
    plots: dict[str, str] = field(default_factory=dict)
    config: str = ""
    warnings: list[str] = field(default_factory=list)


def build_report(contents: Contents) -> str:
    """Return the whole page as HTML. `metrics` is what `evaluate` returns; absent values show as a dash."""
    parts = [
        f"<h1>{html.escape(contents.title)}</h1><p class=soft>{html.escape(contents.subtitle)}</p>",
        "".join(f"<p class=alarm>{html.escape(warning)}</p>" for warning in contents.warnings),
        _tiles(contents.metrics),
        _strips(contents.strips),
        _plot(contents, "trajectory", "Trajectory"),
        _tables(contents.metrics),
        _plot(contents, "seconds", "Time"),
        _settings(contents),
    ]
    head = "<meta charset=utf-8><meta name=viewport content='width=device-width'>"
    title, body = html.escape(contents.title), "\n".join(parts)
    return (
        f"<!doctype html>\n<html lang=en>{head}<title>{title}</title><style>{STYLE}</style>\n"
        f"<main>\n{body}\n</main></html>\n"
    )


def number(value: float | None, digits: int, scale: float = 1.0) -> str:
    """Write a figure with fixed digits and thin thousands, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value * scale:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def headline(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the figures of first interest as (name, value, unit), in order; for the page's top and the CLI's table."""
    ate, held_out = metrics.get("ate") or {}, metrics.get("held_out") or {}
    found = metrics.get("reconstruction")
    surface = [("Surface F1 at 1 cm", number(found["f1"], 1, 100.0), "%")] if found else []
    return [
        ("ATE RMSE", number(ate.get("rmse_m"), 2, 100.0), "cm"),
        ("PSNR, held-out", number(held_out.get("psnr_db"), 2), "dB"),
        ("Depth L1, held-out", number(held_out.get("depth_l1_m"), 2, 100.0), "cm"),
        *surface,
        ("Spearman V ~ error²", number((metrics.get("uncertainty") or {}).get("spearman"), 3), ""),
        ("Speed", number(metrics.get("frames_per_s"), 2), "frames/s"),
        ("Splats", number(metrics.get("splats"), 0), ""),
        ("Lost frames", number(metrics.get("lost"), 0), f"of {metrics.get('frames', 0)}"),
    ]


def _tiles(metrics: dict[str, Any]) -> str:
    """Show the headline figures as tiles."""
    tiles = [
        f"<div class='card tile'><b>{value} <span class=unit>{unit}</span></b><span>{html.escape(name)}</span></div>"
        for name, value, unit in headline(metrics)
    ]
    return f"<div class=tiles>{''.join(tiles)}</div>"


def _strips(strips: dict[str, list[str]]) -> str:
    """Show the strips of each kind of view under a heading."""
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
            parts += [f"<figure><img loading=lazy src='{html.escape(name)}' alt='view'></figure>" for name in names]
    return "".join(parts)


def _plot(contents: Contents, name: str, title: str) -> str:
    """Show a plot in the version that fits the reader's page."""
    if name not in contents.plots:
        return ""
    stem = f"images/{name}"
    return (
        f"<h2>{title}</h2><figure><picture><source media='(prefers-color-scheme: dark)' srcset='{stem}-dark.png'>"
        f"<img loading=lazy src='{stem}-light.png' alt='{title}'></picture>"
        f"<figcaption>{html.escape(contents.plots[name])}</figcaption></figure>"
    )


def _tables(metrics: dict[str, Any]) -> str:
    """Show the scores of pictures, path, surface and uncertainty in full."""
    cards = [
        ("Pictures", _picture_rows(metrics)),
        ("Path", _path_rows(metrics)),
        ("Surface", _surface_rows(metrics)),
        ("Uncertainty V, held-out", _uncertainty_rows(metrics)),
        ("Reliability of V, held-out", _reliability_rows(metrics)),
    ]
    body = "".join(f"<div class=card><h3>{title}</h3>{_table(rows)}</div>" for title, rows in cards if len(rows) > 1)
    return f"<h2>Scores</h2><div class=pair>{body}</div>"


def _table(rows: list[list[str]]) -> str:
    """Lay out rows of text; the first is the head."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"


def _picture_rows(metrics: dict[str, Any]) -> list[list[str]]:
    kinds = [metrics.get("training") or {}, metrics.get("held_out") or {}]
    lines = [("Views", "views", 0, 1.0), ("PSNR, dB", "psnr_db", 2, 1.0), ("SSIM", "ssim", 4, 1.0),
             ("Depth L1, cm", "depth_l1_m", 2, 100.0), ("Readings covered, %", "depth_coverage", 1, 100.0)]  # fmt: skip
    return [["", "training", "held-out"]] + [
        [label, *(number(kind.get(key), digits, scale) for kind in kinds)] for label, key, digits, scale in lines
    ]


def _path_rows(metrics: dict[str, Any]) -> list[list[str]]:
    ate, rpe = metrics.get("ate"), metrics.get("rpe")
    if not ate or not rpe:
        return []
    rows = [[f"ATE {name}, cm", number(ate[f"{name}_m"], 3, 100.0)] for name in ("rmse", "mean", "median", "max")]
    return [
        ["over all frames, rigidly aligned", f"{ate['pairs']} poses"],
        *rows,
        ["RPE translation, cm per frame", number(rpe["translation_rmse_m"], 3, 100.0)],
        ["RPE rotation, ° per frame", number(rpe["rotation_rmse_deg"], 3)],
    ]


def _surface_rows(metrics: dict[str, Any]) -> list[list[str]]:
    found = metrics.get("reconstruction")
    if not found:
        return []
    lines = [("Accuracy, cm", "accuracy_m", 2), ("Completion, cm", "completion_m", 2),
             ("Completion ratio (< 5 cm), %", "completion_ratio", 1), ("Precision (< 1 cm), %", "precision", 1),
             ("Recall (< 1 cm), %", "recall", 1), ("F1 (1 cm), %", "f1", 1),
             ("Depth L1, novel views, cm", "depth_l1_m", 2), ("… covered, %", "depth_coverage", 1)]  # fmt: skip
    return [["of what a keyframe could see", "mesh.ply"]] + [
        [label, number(found.get(key), digits, 100.0)] for label, key, digits in lines
    ]


def _uncertainty_rows(metrics: dict[str, Any]) -> list[list[str]]:
    scores = metrics.get("uncertainty")
    if not scores:
        return []
    return [
        ["on pixels with a reading", f"{number(scores['pixels'], 0)} pixels"],
        ["Spearman of V and squared error", number(scores["spearman"], 3)],
        ["… where the map covers the pixel", number(scores.get("spearman_covered"), 3)],
        ["AUSE (0 = as good as knowing the error)", number(scores["ause"], 3)],
        ["Gaussian NLL", number(scores["nll"], 3)],
        ["mean V, 10⁻³", number(scores["mean_variance"], 3, 1e3)],
        ["mean squared error, 10⁻³", number(scores["mean_squared_error"], 3, 1e3)],
    ]


def _reliability_rows(metrics: dict[str, Any]) -> list[list[str]]:
    rows = (metrics.get("uncertainty") or {}).get("reliability") or []
    return [["tenth of pixels, by V", "mean V, 10⁻³", "squared error, 10⁻³"]] + [
        [str(i), number(row["predicted"], 3, 1e3), number(row["empirical"], 3, 1e3)] for i, row in enumerate(rows, 1)
    ]


def _settings(contents: Contents) -> str:
    """Show the used configuration, folded."""
    if not contents.config:
        return ""
    return (
        "<h2>Settings</h2><details class=card><summary>config.json, as used</summary>"
        f"<pre>{html.escape(contents.config)}</pre></details>"
    )
