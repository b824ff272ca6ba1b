"""Command `sigmasplat eval`: score a run."""

from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.options import prepare_torch, source_of

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.terminal import Screen
    from sigmasplat.sources.base import Source


def evaluate_run(run: options.RunPath, mesh: options.WithMesh = False, moved_to: options.MovedSource = None) -> int:
    """Score an existing run again. This replaces its metrics, pictures and report.

    example: sigmasplat eval runs/kitchen-sigma
    """
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.run.terminal import Screen

    folder = RunFolder.open(run)
    source = source_of(folder, moved_to)
    prepare_torch()
    score(Screen(), folder, source, mesh)
    return 0


def score(screen: "Screen", folder: "RunFolder", source: "Source", mesh: bool = False) -> None:
    """Score the run; print the scores and the path of the report, which exists even if the truth does not match."""
    from sigmasplat.evaluation.evaluate import evaluate

    try:
        with screen.counting("evaluation") as progress:
            metrics = evaluate(folder, source, mesh=mesh, progress=progress)
        screen.results(metrics)
    except Exception as problem:
        problem.add_note(f"the run is in {folder.path}")
        raise
    finally:
        report = folder.path / "report.html"
        if report.exists():
            screen.say(f"report: {report.resolve()}")
