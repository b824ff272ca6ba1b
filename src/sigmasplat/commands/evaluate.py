"""Command `sigmasplat eval`: score a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sigmasplat.commands import options
from sigmasplat.commands.input_options import arg, flag
from sigmasplat.commands.options import prepare_torch, source_of
from sigmasplat.env import LPIPS_FOLDER

if TYPE_CHECKING:
    from sigmasplat.input.source import Source
    from sigmasplat.plugins.evaluation.metrics.lpips import Lpips
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder


@dataclass(frozen=True)
class EvalOptions:
    """Options of eval: what to score besides path, views and uncertainty."""

    true_mesh: Annotated[Path | None, arg(
        "FILE", "also write mesh.ply, and score it against this PLY in the world frame of the true path",
        "(default: that of the data set)",
    )] = None  # fmt: skip
    random_views: Annotated[
        int, arg("N", "number of random views that score the depth of mesh.ply; papers use 1000")
    ] = 1000
    full_resolution: Annotated[bool, flag("also score the views at the resolution of the recording")] = False
    lpips: Annotated[Path | None, arg(
        "DIR", "folder of the weights of LPIPS; `sigmasplat download lpips alex` gets them",
        f"(default: {LPIPS_FOLDER}, if it exists)",
    )] = None  # fmt: skip

    def network(self) -> tuple["Lpips | None", str]:
        """Load the network of LPIPS, or return the line that says why it is not scored. Raises ConfigError if weights
        are damaged, or missing in a folder that was given."""
        from sigmasplat.plugins.evaluation.metrics.lpips import Lpips, find_lpips

        return (Lpips.load(self.lpips), "") if self.lpips is not None else find_lpips(LPIPS_FOLDER)


DEFAULT_EVAL_OPTIONS = EvalOptions()


def evaluate_run(
    run: options.RunPath, mesh: options.WithMesh = False, moved_to: options.MovedSource = None,
    eval_options: Annotated[EvalOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes] = DEFAULT_EVAL_OPTIONS,
) -> int:  # fmt: skip
    """Score an existing run again. This replaces its metrics, pictures and report.

    example: sigmasplat eval runs/kitchen-sigma
    """
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder

    folder, screen = RunFolder.open(run), Screen()
    with folder.locked(screen.warn):
        folder.remove_leftovers()
        source = source_of(folder, moved_to)
        prepare_torch()
        if unscored := score(screen, folder, source, mesh, eval_options):
            screen.say(unscored)
    return 0


def score(
    screen: "Screen", folder: "RunFolder", source: "Source", mesh: bool = False,
    eval_options: EvalOptions = DEFAULT_EVAL_OPTIONS,
) -> str:  # fmt: skip
    """Score the run; print the result, the path of the report, which exists even if the truth does not match, and the
    next commands.

    Returns the line that says why LPIPS is not scored, or "".
    """
    from sigmasplat.data.camera_errors import sensor_said
    from sigmasplat.plugins.evaluation.evaluate import evaluate
    from sigmasplat.plugins.evaluation.report.advice import next_commands
    from sigmasplat.plugins.evaluation.report.summary import result_sentence
    from sigmasplat.plugins.evaluation.report.tables import key_figures
    from sigmasplat.plugins.outputs.mesh_files import read_mesh

    try:
        lpips, unscored = eval_options.network()
        true_mesh = read_mesh(eval_options.true_mesh) if eval_options.true_mesh else None
        with screen.counting("evaluation") as progress:
            metrics = evaluate(
                folder, source, mesh=mesh or true_mesh is not None, true_mesh=true_mesh,
                random_views=eval_options.random_views, full_resolution=eval_options.full_resolution,
                lpips=lpips, progress=progress,
            )  # fmt: skip
        screen.results(result_sentence(metrics), key_figures(metrics))
        if sensor := sensor_said(folder.facts()):
            screen.say(sensor)
    except Exception as problem:
        problem.add_note(f"the run is in {folder.path}")
        raise
    finally:
        report = folder.path / "report.html"
        if report.exists():
            screen.say(f"report: {report.resolve()}")
    screen.next_commands((command for _, command in next_commands(str(folder.path))), alarms=metrics.get("alarms", {}))
    return unscored
