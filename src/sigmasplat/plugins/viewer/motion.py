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
"""A new browser may report other poses for so long. Then its sway begins."""
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
        if sway is None or not sway.sent:
            return False
        near_m = OWN_RAD * float(np.linalg.norm(sway.position - sway.look_at))
        return all(np.linalg.norm(client.camera.position - sent) > near_m for sent in tuple(sway.sent))

    def _work(self) -> None:
        while not self._stop.wait(STEP_S):
            clients, now_s = self.server.get_clients() if self.wanted() else {}, time.monotonic()
            self._sways = {n: self._sways.get(n) or _sway(client.camera) for n, client in clients.items()}
            for n, sway in self._sways.items():
                swaying_s = now_s - sway.since_s
                if swaying_s < 0.0:
                    continue
                angle = SWAY_RAD * np.sin(2.0 * np.pi * swaying_s / PERIOD_S)
                R = se3.exp(np.r_[0.0, 0.0, 0.0, angle * sway.up / np.linalg.norm(sway.up)])[:3, :3]
                sway.sent.append(sway.look_at + R @ (sway.position - sway.look_at))
                with clients[n].atomic():
                    clients[n].camera.position, clients[n].camera.look_at = sway.sent[-1], sway.look_at


def _sway(c: viser.CameraHandle) -> Sway:
    return Sway(c.position, c.look_at, c.up_direction, time.monotonic() + SETTLING_S, deque(maxlen=30))
