"""Move browsers' cameras gently around what they look at, until a person moves one."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import viser

from sigmasplat.api import Matrix, se3

STEP_S, PERIOD_S, SWAY_RAD = 0.1, 10.0, np.deg2rad(2.0)
SETTLING_S = 2.0
"""A new browser may report other poses for so long."""
OWN_RAD = np.deg2rad(0.3)
"""A camera reported within this angle of a sent one was moved by the server: a pixel of a person's mouse is more."""


class Sway(NamedTuple):
    """What a browser's camera sways about, since when, and the positions that were sent last."""

    position: Matrix
    look_at: Matrix
    up: Matrix
    since_s: float
    sent: deque[Matrix]


class CameraSway:
    """Sways the cameras of all browsers while `wanted()`, in one thread."""

    def __init__(self, server: viser.ViserServer, wanted: Callable[[], bool]) -> None:
        self.server, self.wanted = server, wanted
        self._sways: dict[int, Sway] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="sway", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def moved_by_person(self, client: viser.ClientHandle) -> bool:
        """Return whether a swaying camera is where the server has not sent it."""
        sway = self._sways.get(client.client_id)
        if sway is None or time.monotonic() - sway.since_s < SETTLING_S:
            return False
        near_m = OWN_RAD * float(np.linalg.norm(sway.position - sway.look_at))
        return all(np.linalg.norm(client.camera.position - sent) > near_m for sent in tuple(sway.sent))

    def _work(self) -> None:
        while not self._stop.wait(STEP_S):
            clients, before = self.server.get_clients() if self.wanted() else {}, self._sways
            now_s = time.monotonic()
            new = {n: Sway(c.position, c.look_at, c.up_direction, now_s, deque(maxlen=30))
                   for n, c in ((n, client.camera) for n, client in clients.items() if n not in before)}  # fmt: skip
            self._sways = {n: sway for n, sway in (before | new).items() if n in clients}
            for n, sway in self._sways.items():
                angle = SWAY_RAD * np.sin(2.0 * np.pi * (now_s - sway.since_s) / PERIOD_S)
                R = se3.exp(np.r_[0.0, 0.0, 0.0, angle * sway.up / np.linalg.norm(sway.up)])[:3, :3]
                sway.sent.append(sway.look_at + R @ (sway.position - sway.look_at))
                with clients[n].atomic():
                    clients[n].camera.position, clients[n].camera.look_at = sway.sent[-1], sway.look_at
