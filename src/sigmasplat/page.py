"""Put a scored run onto its page, report.html: one file that can be sent, readable by somebody who was not there."""

import json
from functools import partial
from typing import Any

from sigmasplat.errors import RunError
from sigmasplat.io.embedded import data_uri
from sigmasplat.io.runs import RunFolder
from sigmasplat.metrics.report import Contents, build_report
from sigmasplat.metrics.story import advice, in_short


def write_page(
    run: RunFolder,
    metrics: dict[str, Any],
    strips: dict[str, list[str]],
    plots: dict[str, str],
    warnings: list[str],
) -> None:
    """Write report.html from metrics and the pictures in images/; `strips` names views by kind, `plots` holds captions.

    Raises RunError if a picture cannot be read or the page not be written.
    """
    config, facts = run.config(), run.facts()
    contents = Contents(
        title=f"SigmaSplat · {metrics.get('source')}",
        subtitle=" · ".join([config.name, f"version {facts.get('version')}", _machine(run), str(facts.get("status"))]),
        metrics=metrics,
        strips=strips,
        plots=plots,
        config=json.dumps(config.to_dict(), indent=2),
        warnings=warnings,
        loops=run.read_loops(),
        story=in_short(metrics, _machine(run)),
        advice=advice(metrics, str(run.path), str(facts.get("source_path") or "PATH"), config.to_dict()),
        seconds=_seconds(run),
        picture=partial(_shown, run),
    )
    run.write_report(build_report(contents))


def _machine(run: RunFolder) -> str:
    made_on = run.facts().get("machine") or {}
    return f"{made_on.get('cpu')}, {made_on.get('cores')} cores"


def _seconds(run: RunFolder) -> dict[str, float]:
    """Return the seconds of each stage; none where the run stopped before it noted them."""
    try:
        return run.read_profile()
    except RunError:
        return {}


def _shown(run: RunFolder, name: str) -> str:
    """Return a picture as the page holds it; charts keep their sharp lines."""
    return data_uri(run.path / name, lossless="view-" not in name)
