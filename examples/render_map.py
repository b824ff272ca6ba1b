"""Render a map's colour and uncertainty, side by side, from one pose of its path.

python examples/render_map.py RUN [PICTURE.png] [ROW]      RUN a run folder, ROW a row of its trajectory (default: 0)
python examples/render_map.py MAP [PICTURE.png]            MAP a PLY; the view is from the origin of its
                                                           coordinates

The right half is √V, with V averaged over the channels: dark = certain, bright = uncertain. Where the map is empty
(A < ½) V is meaningless; those pixels are slate gray.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from sigmasplat import Camera, SigmaSplatError
from sigmasplat.data import se3
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.render import render
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.run_folder.splat_ply import read_field

CAMERA = Camera(width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
"""Any pinhole camera works; it need not be the one that recorded the map."""


def main(run: str, picture: str = "view.png", row: str = "0") -> None:
    """Render a map from a pose of its run's trajectory and save colour and uncertainty as one PNG."""
    if Path(run).is_file():
        field, T_world_camera = read_field(Path(run)), np.eye(4)
    else:
        folder = RunFolder.open(Path(run))
        field, T_world_camera = folder.read_map(), folder.read_trajectory().T_world_camera[int(row)]
    with torch.no_grad():
        view = render(field, CAMERA, se3.inverse(T_world_camera))
    covered = view.alpha.numpy() > 0.5
    color = (view.color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    deviation = view.variance.mean(-1).clamp(min=0.0).sqrt().numpy()
    high = colormap.value_range(deviation, covered)[1]
    unsure = colormap.apply_masked(deviation, covered, 0.0, high, colormap.INFERNO)
    Image.fromarray(np.concatenate([color, unsure], axis=1)).save(picture)
    print(f"{picture}: {covered.mean():.0%} of the view is mapped")
    if covered.any():
        print(f"median √V there is {np.median(deviation[covered]):.3f} (colour in 0 … 1)")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except SigmaSplatError as problem:
        sys.exit(str(problem))
