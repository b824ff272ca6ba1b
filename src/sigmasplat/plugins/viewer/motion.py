"""Sway browsers' cameras gently around what they look at, until a person moves one."""

import threading
import time
from collections.abc import Callable

import numpy as np
import viser

from sigmasplat.api import Matrix, se3

STEP_S, PERIOD_S, SWAY_RAD = 0.1, 10.0, np.deg2rad(2.0)
SETTLING_S = 2.0
"""A new browser may report other poses for so long. Then its sway begins."""
MOVED_RAD = np.deg2rad(1.0)
"""A person has moved a camera that is farther from where it was sent, seen from what it looks at. The sway's own delay
is less; a mouse moves it so far by two pixels."""


def sway(
    server: viser.ViserServer, wanted: Callable[[], bool], moved: Callable[[], None], stop: threading.Event
) -> None:
    """Sway the cameras of all browsers while `wanted()`, and call `moved()` when a person moves one, until `stop`."""
    starts: dict[int, tuple[float, Matrix, Matrix, Matrix]] = {}
    sent: dict[int, Matrix] = {}
    while not stop.wait(STEP_S):
        clients, now_s = server.get_clients() if wanted() else {}, time.monotonic()
        starts = {n: starts[n] for n in clients if n in starts}
        for n, c in ((n, client.camera) for n, client in clients.items()):
            if n not in starts:
                starts[n], sent[n] = (now_s + SETTLING_S, c.position, c.look_at, c.up_direction), c.position
            begin_s, position, look_at, up = starts[n]
            if now_s < begin_s:
                continue
            if np.linalg.norm(c.position - sent[n]) > MOVED_RAD * np.linalg.norm(position - look_at):
                moved()
                break
            angle = SWAY_RAD * np.sin(2.0 * np.pi * (now_s - begin_s) / PERIOD_S)
            R = se3.exp(np.r_[0.0, 0.0, 0.0, angle * up / np.linalg.norm(up)])[:3, :3]
            sent[n] = look_at + R @ (position - look_at)
            with clients[n].atomic():
                c.position, c.look_at = sent[n], look_at
