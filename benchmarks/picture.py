"""Draw the picture of a real scan that README.md shows: sensor, map, uncertainty, and the map seen from above.

Reads a finished run of an RGB-D sequence and measures nothing. The recording of the committed picture is fr1/xyz of TUM
RGB-D (J. Sturm et al., IROS 2012; CC BY 4.0).

example: sigmasplat run DATA/fr1_xyz --out runs/desk && python benchmarks/picture.py runs/desk
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import record
import torch
import tyro

from sigmasplat.data import se3
from sigmasplat.errors import SigmaSplatError
from sigmasplat.plugins.evaluation.view_scores import scored_view
from sigmasplat.plugins.outputs.drawing.view_panels import BACKGROUND, ViewPanel, draw_view_strip, view_panels
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.plugins.outputs.video import Film
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer
from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg
BACK_M, UP_M, DOWN_RAD = 0.8, 0.6, 0.35
"""How far behind and above the camera of the first panels the last one looks from, and how much further down."""
Run = Annotated[Path, tyro.conf.Positional, arg(help="folder of a finished run")]
Index = Annotated[int, arg(help="frame of the first three panels")]
Out = Annotated[Path, arg(help="picture to write")]


def panels(run: RunFolder, index: int) -> list[ViewPanel]:
    """Render the four panels. Raises RunError or SourceError where run or sequence cannot be read."""
    reader, source = RunReader(run), open_source(run.facts()["source_path"])
    config, field = reader.config, run.read_map()
    renderer = FieldRenderer(config.render, config.backend)
    frame = source.frame(index).prepared(0, config.input.min_depth_m, config.input.max_depth_m)
    T_world_camera = reader.poses_of([index]).T_world_camera[0]
    T_camera_above = se3.exp(np.array([0.0, 0.0, 0.0, -DOWN_RAD, 0.0, 0.0]))
    T_camera_above[:3, 3] = 0.0, -UP_M, -BACK_M
    with torch.inference_mode():
        view = scored_view(frame, renderer(field, frame.camera, se3.inverse(T_world_camera)), "")
        above = Film.of(reader, frame.camera, renderer).seen(T_world_camera @ T_camera_above)
    backdrop = np.array(BACKGROUND, np.float32) / 255.0
    seen = above.color.numpy() + (1.0 - above.alpha.numpy()[..., None]) * backdrop
    pixels = (np.clip(seen, 0.0, 1.0) * 255.0).round().astype(np.uint8)
    sensor, rendered, _, uncertainty, _ = view_panels(view)
    return [
        replace(sensor, title="sensor", caption=f"{run.facts()['source']}, frame {index}"),
        replace(rendered, title="map, same view", caption=f"{len(field):,} splats"),
        replace(uncertainty, title="uncertainty of the colour"),
        ViewPanel("map, from above", pixels),
    ]


def main(run: Run, frame: Index = 250, out: Out = record.ROOT / "docs" / "images" / "scan.jpg") -> int:
    """Draw the picture of a real scan; exit code 2 if the run or its sequence cannot be read."""
    try:
        drawn = panels(RunFolder.open(run), frame)
    except SigmaSplatError as problem:
        print(f"picture.py: {problem}", file=sys.stderr)
        return 2
    draw_view_strip(drawn).save(out, quality=88)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,)))
