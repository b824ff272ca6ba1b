"""Run SLAM on a sequence from Python and write its path and map.

python examples/run_sequence.py PATH [OUT]      PATH as for `sigmasplat run`, OUT a folder (default: sequence-out)
"""

import sys
from pathlib import Path

from sigmasplat import SigmaSplatError, Slam, open_scene, preset
from sigmasplat.run_folder.splat_ply import write_field
from sigmasplat.run_folder.trajectory import write_trajectory


def main(path: str, out: str = "sequence-out") -> None:
    """Track and map every frame of `path`; write trajectory.txt (TUM text) and map.ply (3DGS PLY) into `out`."""
    source, config = open_scene(path, preset("varsplat-fast"))
    slam = Slam(config)
    for frame in source:
        step = slam.step(frame)
        x, y, z = step.T_world_camera[:3, 3]
        remark = "lost" if step.lost else "mapped" if step.is_keyframe else ""
        print(f"{step.index:5d}  x={x:+.3f} y={y:+.3f} z={z:+.3f} m  {step.splats} splats  {remark}")
    slam.finish()  # looks for the last submap's loops and makes one map of all
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_trajectory(folder / "trajectory.txt", slam.trajectory())
    write_field(folder / "map.ply", slam.field)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except SigmaSplatError as problem:
        sys.exit(str(problem))
