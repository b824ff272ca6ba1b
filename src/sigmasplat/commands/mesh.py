"""Extract a surface from a run's map: sigmasplat mesh."""

from sigmasplat.commands import options
from sigmasplat.commands.options import prepare_torch, refuse_existing, source_of


def make_mesh(
    run: options.RunPath,
    voxel_m: options.VoxelM = 0.01,
    out: options.MeshFile = None,
    overwrite: options.Overwrite = False,
    moved_to: options.MovedSource = None,
) -> int:
    """Extract a coloured triangle mesh from a run's map, by fusing renders at its keyframes.

    example: sigmasplat mesh runs/kitchen-sigma --out kitchen.glb
    """
    from sigmasplat.evaluation.reconstruct import FusionInput
    from sigmasplat.io.mesh import check_ending, write_mesh
    from sigmasplat.io.runs import MESH, RunFolder
    from sigmasplat.run.terminal import Screen

    screen, folder, target = Screen(), RunFolder.open(run), out or run / MESH
    check_ending(target)
    refuse_existing(out, overwrite)
    source = source_of(folder, moved_to)
    prepare_torch()
    with screen.counting("surface") as progress:
        surface = FusionInput.of(folder, source.camera).surface(voxel_m, progress=progress)
    write_mesh(target, surface)
    screen.say(f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles: {target}")
    return 0
