"""Extract a surface from a run's map: sigmasplat mesh."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from sigmasplat.commands import options
from sigmasplat.commands.input_options import arg, flag
from sigmasplat.commands.options import prepare_torch, refuse_existing
from sigmasplat.config.ranges import Range
from sigmasplat.errors import ConfigError

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.axes import Axes

MeshAxes = Annotated[Literal["y-up", "z-up", "y-down", "camera"] | None, arg(
    "{y-up,z-up,y-down,camera}", "axes of the file: y-up for viewers, z-up for CAD, y-down, or camera, those of the "
    "run's path; all but camera are levelled (docs/exports.md)", "(default: y-up; mesh.ply in RUN: camera)",
)]  # fmt: skip

Triangles = Annotated[int | None, Range(0), arg(
    "N", "largest number of triangles; 0 = no limit", "(default: 300000; with a texture 60000)",
)]  # fmt: skip
FillGaps = Annotated[float, Range(0), arg(
    "M", "close gaps that are at most M metres across by smooth patches, which have a high depth_std_m; 0 = none",
)]  # fmt: skip
MeshFile = Annotated[Path | None, arg(
    "FILE", "file to write: .glb or .usdz (textured), .ply or .stl (no colours)", "(default: mesh.ply in RUN)",
)]  # fmt: skip


def make_mesh(
    run: options.RunPath, voxel_m: options.VoxelM = None,
    triangles: Triangles = None,
    texture: Annotated[bool, flag("colour the vertices of a GLB instead of giving it a texture")] = True,
    axes: MeshAxes = None, up: options.UpEdge = "auto",
    fill_gaps: FillGaps = 0.0, out: MeshFile = None, overwrite: options.Overwrite = False,
) -> int:  # fmt: skip
    """Extract a coloured triangle mesh from a run's map, upright and in metres.

    example: sigmasplat mesh runs/kitchen-sigma --out kitchen.glb
    """
    from sigmasplat.files.lock import output_locked
    from sigmasplat.plugins.evaluation.reconstruct import FusionInput
    from sigmasplat.plugins.outputs.axes import levelled, transform_to
    from sigmasplat.plugins.outputs.mesh_editing import decimated, filled
    from sigmasplat.plugins.outputs.mesh_files import check_ending, write_mesh
    from sigmasplat.plugins.outputs.mesh_texture import textured
    from sigmasplat.plugins.outputs.run_reader import RunReader
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import MESH, RunFolder

    screen, reader, target = Screen(), RunReader(RunFolder.open(run)), out or run / MESH
    check_ending(target)
    texture = _has_texture(target, texture, axes)
    triangles = (60_000 if texture else 300_000) if triangles is None else triangles
    chosen: Axes = axes or ("y-up" if out else "camera")  # the run's own mesh.ply has the axes of its other files
    refuse_existing(out, overwrite)
    prepare_torch()
    with output_locked(out, screen.warn) if out else reader.run.locked(screen.warn):
        fusion_input = FusionInput.at(reader.run, reader.camera)
        with screen.counting("surface") as progress:
            surface = fusion_input.surface(voxel_m, progress=progress)
        seen, surface = len(surface.vertices), filled(surface, fill_gaps)
        if fill_gaps:
            unseen = len(surface.vertices) - seen
            screen.say(f"gaps up to {fill_gaps:g} m are closed: {unseen:,} vertices nobody has seen")
        if len(surface.faces) > triangles > 0:
            screen.say(f"{len(surface.faces):,} triangles are reduced to {triangles:,} (--triangles)")
            surface = decimated(surface, triangles)
        surface = surface.with_faces(surface.areas() > 0.0)
        if texture and len(surface.faces):
            with screen.counting("texture") as progress:
                surface = textured(surface, *fusion_input.views(), fusion_input.config, progress)
        if chosen != "camera":
            R_floor_world, said, confirmed = levelled(reader, up)
            (screen.say if confirmed else screen.warn)(said)
            surface = surface.moved(transform_to(chosen, R_floor_world))
        write_mesh(target, surface, f"sigmasplat, unit metre, axes {chosen}")
        screen.say(f"axes {chosen}, {len(surface.vertices):,} vertices, {len(surface.faces):,} triangles: {target}")
    return 0


def _has_texture(target: Path, texture: bool, axes: "Axes | None") -> bool:
    """Return whether a file gets a texture. Raises ConfigError for options that its format does not have."""
    kind = target.suffix.lower()[1:].upper()
    if kind not in ("GLB", "USDZ"):
        return False
    if axes not in (None, "y-up"):
        raise ConfigError(f"a {kind} has y up by definition, so --axes {axes} cannot be used; leave --axes out")
    if kind == "USDZ" and not texture:
        raise ConfigError("a USDZ has a texture, so --no-texture cannot be used; leave it out, or write a GLB")
    return texture
