"""Find the images of a recording in the map of a finished run: sigmasplat localise."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, InputOptionsFlat
from sigmasplat.commands.options import prepare_torch, refuse_existing, working_images
from sigmasplat.config.scale import for_scene
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError, RunError

if TYPE_CHECKING:
    from rich.table import Table

    from sigmasplat.run.localise import Localisation

OK, NONE_FOUND = 0, 1
ENDINGS = (".jsonl", ".txt")
MOST_ROWS = 60
"""Number of images up to which the table shows all of them; else it shows about this many, evenly spread."""


def localise(
    path: options.SourcePath, run: options.InRun, out: options.PosesFile = None, overwrite: options.Overwrite = False,
    input_options: InputOptionsFlat = DEFAULT_INPUT_OPTIONS, settings: options.Settings = (),
) -> int:  # fmt: skip
    """Find the images of a recording in the map of a finished run: pose, uncertainty, and a verdict for each image.

    exit code 1 if no image was found; example: sigmasplat localise data/kitchen2 --in runs/kitchen-sigma --stride 10
    """
    from sigmasplat.plugins.sources import open_source
    from sigmasplat.run.finished_map import FinishedMap
    from sigmasplat.run.localise import FOUND, Localiser, write_localisations
    from sigmasplat.run.terminal import Screen
    from sigmasplat.run_folder.runs import RunFolder

    if out and out.suffix not in ENDINGS:
        raise ConfigError(f"--out must end in {' or '.join(ENDINGS)}, found {out.name}")
    refuse_existing(out, overwrite)
    screen, finished = Screen(), FinishedMap.of(RunFolder.open(run))
    # Frames and calibration are not those of the run.
    given = working_images(finished.config) | input_options.settings() | split_settings(settings)
    config = override(finished.config, given)
    source = open_source(path, config.input)
    config = for_scene(config, 1.0, source.depth_noise_per_m, split_settings(settings))  # its lengths are the map's
    if source.live:
        raise RunError("a live camera cannot be localised; record it first, then give the folder of the recording")
    finished.refuse_other_view(source.camera.prepared(config.input.width, config.input.crop_px))
    prepare_torch()
    localiser = Localiser(finished, config)
    with screen.counting("localise") as progress:
        found = []
        for frame in source:
            found.append(localiser.locate(frame))
            progress(len(found), len(source))
    screen.out.print(_table(found))
    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} unreadable {images} skipped (first: {source.skipped[0]})")
    count = sum(result.verdict == FOUND for result in found)
    screen.say(f"{count} of {len(found)} images found in {run}")
    if out:
        write_localisations(out, found)
        screen.say(f"results: {out}")
    return OK if count else NONE_FOUND


def _table(found: Sequence["Localisation"]) -> "Table":
    from rich.table import Table

    table = Table("image", "verdict", "camera in the world, or why not")
    for r in found[:: -(-len(found) // MOST_ROWS) or 1]:
        table.add_row(str(r.index), r.verdict, _place(r))
    return table


def _place(r: "Localisation") -> str:
    """Return the position with its standard deviation, and where it was found; else the reason."""
    if r.T_world_camera is None or r.component:
        return r.reason
    xyz = " ".join(f"{v:.3f}" for v in r.T_world_camera[:3, 3])
    return f"{xyz} m ± {100 * r.position_m:.1f} cm, submap {r.submap}, keyframe {r.keyframe}"
