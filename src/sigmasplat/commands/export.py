"""Write what a run made in other programs' formats: sigmasplat export."""

from pathlib import Path

from sigmasplat.commands import options
from sigmasplat.commands.options import refuse_existing


def export(
    run: options.RunPath,
    out: options.OutFile = None,
    format: options.Format = None,
    overwrite: options.Overwrite = False,
) -> int:
    """Write a run's map as 3DGS PLY for SuperSplat and other viewers, or its path as TUM text.

    example: sigmasplat export runs/kitchen --out kitchen.ply
    """
    from sigmasplat.io import ply, trajectory
    from sigmasplat.io.runs import RunFolder

    folder = RunFolder.open(run)
    chosen = format or ("trajectory" if out and out.suffix == ".txt" else "ply")
    target = out or Path(folder.path.resolve().name + {"ply": ".ply", "trajectory": ".txt"}[chosen])
    refuse_existing(target, overwrite)
    if chosen == "ply":
        ply.write_field(target, folder.read_map())
    else:
        trajectory.write_trajectory(target, folder.read_trajectory())
    print(target)
    return 0
