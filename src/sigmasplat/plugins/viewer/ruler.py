"""Measure the distance between two points that a person clicks in the scene."""

from collections.abc import Callable

import numpy as np
import torch
import viser

from sigmasplat.api import Camera, Matrix, predict, render, se3
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA
from sigmasplat.plugins.outputs.video import look_along
from sigmasplat.plugins.viewer.layers import ShownMap

PICKED = Camera(17, 17, 500.0, 500.0, 8.0, 8.0)
"""Renders the surroundings of a clicked point, as sharp as an image 500 pixels wide."""


def point_on_ray(shown: ShownMap, origin: Matrix, direction: Matrix) -> tuple[Matrix, float] | None:
    """Return where a ray [3], [3] meets the surface, D/A in m of the rendered depth where A > ½, and one standard
    deviation (m, nan if not measured) of that depth; None where the map has no surface."""
    forward = direction / np.linalg.norm(direction)
    T_camera_world = se3.inverse(look_along(origin, forward, np.eye(3)[np.abs(forward).argmin()]))
    middle, std_m = (PICKED.height // 2, PICKED.width // 2), float("nan")
    with torch.inference_mode():
        seen = render(shown.field, PICKED, T_camera_world, None, shown.options, shown.backend)
        if (alpha := float(seen.alpha[middle])) <= COVERED_ALPHA:
            return None
        if shown.known is not None:
            found = predict(shown.field, shown.known, PICKED, T_camera_world, shown.options, shown.backend)
            std_m = float(found.depth_std_m[middle])
    return origin + forward * (float(seen.depth[middle]) / alpha), std_m


class Ruler:
    """Two clicks after `start` measure a distance; `show(points, text)` draws what is known so far."""

    def __init__(
        self, server: viser.ViserServer, shown: Callable[[], ShownMap | None], show: Callable[[list[Matrix], str], None]
    ) -> None:
        self.server, self.shown, self.show = server, shown, show
        self._ends: list[tuple[Matrix, float]] = []

    def start(self) -> None:
        """Remove the last distance and wait for two clicks."""
        self._ends = []
        self.show([], "click the first point")
        self.server.scene.remove_click_callback(self.clicked)
        self.server.scene.on_click()(self.clicked)

    def clicked(self, event: viser.SceneClickEvent) -> None:
        """Add the clicked point. ± is one standard deviation at most: as if both errors lay along the distance."""
        shown = self.shown()
        found = shown and point_on_ray(shown, np.array(event.ray_origin), np.array(event.ray_direction))
        self._ends += [found] if found else []
        points, text = [point for point, _ in self._ends], "click the second point"
        if len(points) == 2:
            self.server.scene.remove_click_callback(self.clicked)
            std_m = float(np.hypot(self._ends[0][1], self._ends[1][1]))
            text = f"{np.linalg.norm(points[1] - points[0]):.3f} m"
            text += "" if np.isnan(std_m) else f" ± {100.0 * std_m:.1f} cm"
        self.show(points, text if found else "no surface there: click another point")
