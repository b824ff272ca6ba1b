"""Tracking by descent, as in the papers: no frame is lost or tried again, except where its first loss jumps."""

from typing import Any

import numpy as np
import pytest

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.fit.pose import PoseFit
from sigmasplat.plugins.sources import SyntheticRoom
from sigmasplat.system.slam import Slam
from sigmasplat.tracking import tracker

SMALL = {
    "seeding.first_uniform": "400", "seeding.first_gradient": "100", "mapping.first_iterations": "2",
    "mapping.iterations": "1", "tracking.iterations": "7", "submaps.distance_m": "0", "loops.close": "false",
    "final.iterations": "0", "input.crop_px": "0",
}  # fmt: skip


@pytest.mark.parametrize(
    ("restart", "first_loss", "steps"),
    [
        ("off", 1e9, [7]), ("longer", 4.9, [7]), ("longer", 5.1, [7, 14]),
        ("odometry", 49.9, [7]), ("odometry", 50.1, [7, 14]),
    ],
)  # fmt: skip
def test_a_descent_restarts_where_its_first_loss_exceeds_the_last_losses(
    monkeypatch: pytest.MonkeyPatch, restart: str, first_loss: float, steps: list[int]
) -> None:
    """Each fit explains a hundredth of the image, begins at a loss far above 1 and ends at 1."""
    asked: list[tuple[np.ndarray, int]] = []

    def fit(params: Any, view: Any, target: Any, T_camera_world: np.ndarray, config: Any, iterations: int) -> PoseFit:
        asked.append((T_camera_world, iterations))
        return PoseFit(T_camera_world, 0.1, 0.1, first_loss, 1.0, iterations)

    monkeypatch.setattr(tracker, "fit_pose_adam", fit)
    room = SyntheticRoom(frames=200, width=80, height=60)
    slam = Slam(override(preset("varsplat-tum"), SMALL | {"tracking.restart": restart}))
    found = [slam.step(room.frame(i)) for i in range(3)]
    assert [step.state for step in found] == ["tracked"] * 3 and asked[0][1] == 7
    of_last = asked[1:]  # nothing is known before the first tracked frame
    assert [iterations for _, iterations in of_last] == steps
    same_start = np.allclose(of_last[0][0], of_last[-1][0], atol=1e-9)
    assert same_start == (len(steps) == 1 or restart == "longer")
