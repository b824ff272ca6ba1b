"""Measure what each format of a map costs: size, size per square metre, held-out PSNR after reading back, and time.

The map of a finished run is exported in every format of splats, read back and rendered at the run's
held-out views. The area is that of the surface that
`sigmasplat mesh` extracts with voxels of 4 cm.
Writes benchmarks/results/export-sizes-<machine>.json and prints a table.

example: sigmasplat run data/redkitchen --hold-out 10 --out runs/kitchen; python benchmarks/export_sizes.py runs/kitchen
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import program
import record
import tyro
from splat_readers import read_any
from tables import Section, significant

from sigmasplat.commands.export import ExportOptions
from sigmasplat.commands.options import source_of
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.errors import SigmaSplatError, SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation import view_scores
from sigmasplat.plugins.evaluation.reconstruct import FusionInput
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.plugins.outputs.formats import PLUGIN, ExportSource, choose
from sigmasplat.render import FieldRenderer
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
VOXEL_M = 0.04
GOAL_MB, GOAL_SHARE = 3.0, 0.99
VARIANTS: tuple[tuple[str, str, Mapping[str, Any]], ...] = (
    ("PLY", ".ply", {}),
    ("PLY, --plain", ".ply", {"plain": True}),
    ("SPZ", ".spz", {}),
)
"""Names of rows, endings and options of the export."""


@dataclass(frozen=True)
class Options:
    """Measure size and held-out PSNR of a map in each format."""

    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="finished run with held-out frames")]
    source: Annotated[str | None, arg(help="path of the sequence if it has moved")] = None
    views: Annotated[int, arg(help="largest number of held-out views")] = 40
    name: Annotated[str, arg(help="name of the results")] = "export-sizes"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True)
class HeldOutViews:
    """Held-out views of a run: their frames and poses."""

    views: list[tuple[Frame, np.ndarray]]
    renderer: FieldRenderer

    @staticmethod
    def of(run: RunFolder, source: Source, most: int) -> "HeldOutViews":
        """Read the held-out frames of a run. Raises SourceError if every frame was mapped."""
        config, log = run.config(), ExportSource(run.path).reader().frames.posed_log()
        chosen = evenly_spread([found for found in log if not found["is_keyframe"]], most)
        if not chosen:
            raise SourceError(f"{run.path} has no held-out frame; run it with --hold-out 10")
        read = partial(working_frame, source, config.input)
        frames = [(read(found["index"]), np.linalg.inv(found["T_world_camera"])) for found in chosen]
        return HeldOutViews(frames, FieldRenderer(config.render, config.backend))

    def psnr_db(self, field: GaussianField) -> float:
        """Return the mean PSNR of a map over the views, as `sigmasplat eval` scores it."""
        scores = view_scores.ViewScores()
        for frame, T_camera_world in self.views:
            rendered = self.renderer(field, frame.camera, T_camera_world)
            scores.add(view_scores.scored_view(frame, rendered, view_scores.HELD_OUT))
        return float(view_scores.mean_scores(scores.rows)["psnr_db"])


def measure(options: Options) -> dict[str, Any]:
    """Export a run in every format and score it. A format whose library is missing is reported and left out."""
    run = RunFolder.open(options.run)
    source = source_of(run, options.source)
    exported, held_out = ExportSource(options.run), HeldOutViews.of(run, source, options.views)
    field = run.read_map()
    area_m2 = area(FusionInput.at(run, exported.reader().camera).surface(VOXEL_M))
    rows = []
    for name, ending, given in VARIANTS:
        try:
            rows.append({"format": name} | write_and_read(exported, ending, given, held_out))
        except SigmaSplatError as problem:
            rows.append({"format": name, "problem": str(problem)})
        print(rows[-1], file=sys.stderr, flush=True)
    return {
        "source": str(run.facts()["source"]),
        "splats": len(field),
        "area_m2": area_m2,
        "views": len(held_out.views),
        "psnr_db": held_out.psnr_db(field),
        "formats": rows,
    }


def write_and_read(
    source: ExportSource, ending: str, given: Mapping[str, Any], held_out: HeldOutViews
) -> dict[str, Any]:
    """Export in the run's own axes, read back, score; return size, times and PSNR."""
    with TemporaryDirectory() as folder:
        target = Path(folder) / f"map{ending}"
        row = choose(PLUGIN, None, target)
        asked = asdict(ExportOptions()) | {"axes": "camera"} | given
        start_s = time.perf_counter()
        row.write(source, target, **{name: asked[name] for name in row.options})
        written_s = time.perf_counter()
        field = read_any(target)
        read_s = time.perf_counter()
        size = target.stat().st_size
    times = {"write_s": written_s - start_s, "read_s": read_s - written_s}
    return {"bytes": size, "splats": len(field), "psnr_db": held_out.psnr_db(field)} | times


def area(mesh: Mesh) -> float:
    """Return the area of a mesh, m²."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the figures, one row for each format."""
    found = measured["figures"]
    rows = []
    for row in found["formats"]:
        if "problem" in row:
            rows.append([row["format"], row["problem"], *["–"] * 7])
            continue
        mb, share = row["bytes"] / 1e6, row["psnr_db"] / found["psnr_db"]
        reached = mb <= GOAL_MB and share >= GOAL_SHARE
        figures = (mb, mb / found["area_m2"], row["bytes"] / row["splats"])
        rows.append([
            row["format"], f"{row['splats']:,}", *map(significant, figures), f"{row['psnr_db']:.2f}", f"{share:.1%}",
            significant(row["write_s"]), significant(row["read_s"]), "yes" if reached else "no",
        ])  # fmt: skip
    head = (
        "format", "splats", "MB", "MB per m²", "bytes per splat", "PSNR, dB", "of the map's", "write, s", "read, s",
        f"≤ {GOAL_MB:g} MB, ≥ {GOAL_SHARE:.0%}",
    )  # fmt: skip
    note = (
        f"Map of {found['source']}: {found['splats']:,} splats, {found['area_m2']:.0f} m² of surface, "
        f"{found['views']} held-out views."
    )
    return [Section("Size of exported maps", head, rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them; return the exit code."""
    return program.run("export_sizes", options, measure, run=options.run.name)


if __name__ == "__main__":
    program.start(main, Options, __doc__)
