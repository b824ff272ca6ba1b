"""Bring what is known of a run and what the controls ask for onto the screen: one thread, at a bounded rate."""

import contextlib
import ctypes
import sys
import threading
from typing import Any

import viser

from sigmasplat.drawing.colormap import INFERNO
from sigmasplat.errors import SigmaSplatError
from sigmasplat.viewer import lines
from sigmasplat.viewer.panel import Panel, Wanted
from sigmasplat.viewer.pictures import Legend, Picture, legend_picture, picture_of, viewpoint
from sigmasplat.viewer.scene import Scene, look, look_first, pose_of
from sigmasplat.viewer.snapshot import BUDGET, Piece, Snapshot, within_budget
from sigmasplat.viewer.splats import Cut, Floats, cut_of, joined, sigma_span, sigmas, splats_of

REST_S, LIVE_REST_S = 0.05, 0.5
"""After each drawing, so that neither SLAM nor the machine is kept busy by a mouse."""
ROWS, LIVE_ROWS = 480, 240
"""Height of the pictures that are rendered here."""
BACK_M, UP_M = 0.7, 0.25
"""Where the camera that follows another is, behind and above it."""


def give_back_memory() -> None:
    """Return to the system what was allocated for a while: arrays of tens of MB, made again and again by several
    threads, leave holes that glibc keeps; in minutes they add up to hundreds of MB. Elsewhere nothing is done."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class Same:
    """A thing that equals nothing but itself, kept until it is compared: an id alone may be another's by then."""

    def __init__(self, thing: object) -> None:
        self.thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.thing is other.thing

    __hash__ = None  # type: ignore[assignment]


class Stage:
    """Shows moments. `show` and the controls only leave word; a thread of its own does the work, the newest only."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.panel = Panel(server, self.changed, self._look_from)
        self.scene = Scene(server, self._clicked)
        self._moment: Snapshot | None = None
        self._drawn: dict[Any, Any] = {}
        self._sigmas: tuple[list[Same], Floats] = ([], sigmas(()))
        self._joined: tuple[Any, Any] = (None, None)
        self._word, self._stop = threading.Event(), threading.Event()
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(lambda client: self._drawn.pop(("picture", client.client_id), None))
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()

    def show(self, moment: Snapshot) -> None:
        """Show this from now on; returns at once."""
        self._moment = moment
        self.changed()

    def changed(self) -> None:
        """Draw again what has changed."""
        self._word.set()

    def stop(self) -> None:
        """End the thread; the server goes on."""
        self._stop.set()
        self._word.set()
        self._thread.join()

    def _work(self) -> None:
        trimmed: Snapshot | None = None
        while True:
            self._word.wait()
            if self._stop.is_set():
                return
            self._word.clear()
            moment = self._moment
            if moment is not None:
                try:
                    self._draw(moment)
                    if moment is not trimmed:
                        trimmed = moment
                        give_back_memory()
                except Exception as problem:  # a viewer that fails must not end the run that it shows
                    print(f"viewer: {type(problem).__name__}: {problem}", file=sys.stderr)
                self._stop.wait(LIVE_REST_S if moment.live else REST_S)

    def _draw(self, moment: Snapshot) -> None:
        path = moment.path
        whole, parts = moment.final is not None, bool(moment.pieces)
        self.panel.offer(len(path), moment.live, moment.true_positions is not None, whole, parts)
        wanted = self.panel.wanted()
        pieces = moment.shown(wanted.whole, wanted.row)
        ordered = self._sigmas_of(pieces)
        cut = cut_of(ordered, wanted.hidden_share, wanted.least_opacity)
        span = sigma_span(ordered)
        with self.server.atomic():
            self._draw_path(moment, wanted)
            self._draw_splats(pieces, wanted, span, cut)
        self._draw_keyframes(moment, wanted)
        self._say(moment, wanted, pieces, cut)
        self._follow(moment, wanted)
        legend = Legend(INFERNO, *span, "") if wanted.kind == "splats" and wanted.colouring == "σ" else None
        for client in self.server.get_clients().values():
            legend = self._draw_picture(client, moment, wanted, pieces, cut) or legend
        if self._is_new("legend", legend and legend[1:]):
            self.panel.show_legend(None if legend is None else legend_picture(legend))

    def _is_new(self, what: Any, state: Any) -> bool:
        """Tell whether something is not drawn in this state yet, and take note that it is now."""
        if what in self._drawn and self._drawn[what] == state:
            return False
        self._drawn[what] = state
        return True

    def _sigmas_of(self, pieces: tuple[Piece, ...]) -> Floats:
        fields = [Same(piece.field) for piece in pieces]
        if self._sigmas[0] != fields:
            self._sigmas = (fields, sigmas(pieces))
        return self._sigmas[1]

    def _draw_path(self, moment: Snapshot, wanted: Wanted) -> None:
        path, row = moment.path, wanted.row
        if self._is_new("first look", len(path) > 0) and len(path):
            look_first(self.server, path.T_world_camera[0], BACK_M, UP_M)
        if self._is_new("path", (Same(path), row, wanted.path)):
            self.scene.show_lines("path", lines.path_segments(path, row) if wanted.path else None)
            self.scene.show_lost(lines.lost_points(path, row if wanted.path else -1))
            here = path.T_world_camera[min(row, len(path) - 1)] if len(path) else None
            self.scene.show_here(moment.camera, here)
        known = moment.true_positions
        if self._is_new("true path", (Same(known), wanted.true_path)):
            shown = known is not None and wanted.true_path
            self.scene.show_lines("truth", lines.true_segments(known) if shown and known is not None else None)

    def _draw_splats(self, pieces: tuple[Piece, ...], wanted: Wanted, span: tuple[float, float], cut: Cut) -> None:
        if wanted.layer is not None:
            pieces = ()
        ends = span if wanted.colouring == "σ" else None  # its own colours do not depend on the range
        state = ([(p.name, Same(p.field)) for p in pieces], wanted.colouring, ends, cut)
        if self._is_new("splats", state):
            few = within_budget(pieces, BUDGET)  # a final map may be larger; it is rendered whole, but sent thinned
            drawn = {p.name: (splats_of(p.field, wanted.colouring, span, cut), p.T_world_piece) for p in few}
            self.scene.show_splats(drawn)
        else:
            self.scene.place_splats({piece.name: piece.T_world_piece for piece in pieces})

    def _draw_keyframes(self, moment: Snapshot, wanted: Wanted) -> None:
        path = moment.path
        if self._is_new("keyframes", (Same(path), wanted.row, wanted.keyframes, wanted.thumbnails)):
            rows = lines.shown_keyframes(path, wanted.row) if wanted.keyframes else ()
            poses = {row: path.T_world_camera[row] for row in rows}
            self.scene.show_keyframes(moment.camera, poses, moment.picture if wanted.thumbnails else None)

    def _draw_picture(
        self, client: viser.ClientHandle, moment: Snapshot, wanted: Wanted, pieces: tuple[Piece, ...], cut: Cut
    ) -> Legend | None:
        """Render the layer asked for from where a browser looks, and put it behind its scene; return its legend."""
        key, c = ("picture", client.client_id), client.camera
        if wanted.layer is None:
            if self._drawn.pop(key, None) is not None:
                client.scene.set_background_image(None)
            return None
        pose, splats = pose_of(c), ([(Same(p.field), p.T_world_piece.tobytes()) for p in pieces], cut)
        state = (wanted.layer, pose.tobytes(), c.fov, c.aspect, splats)
        drawn = self._drawn.get(key)
        if drawn is None or drawn[0] != state:
            if self._joined[0] != splats:
                self._joined = (splats, joined(pieces, cut))
            camera = viewpoint(c.fov, c.aspect, LIVE_ROWS if moment.live else ROWS)
            made: Picture = picture_of(self._joined[1], camera, pose, wanted.layer, moment.options, moment.backend)
            if client.client_id not in self.server.get_clients():
                return None  # it hung up meanwhile
            client.scene.set_background_image(made.pixels, "jpeg", jpeg_quality=85)
            drawn = self._drawn[key] = (state, made.legend)
        legend: Legend | None = drawn[1]
        return legend

    def _say(self, moment: Snapshot, wanted: Wanted, pieces: tuple[Piece, ...], cut: Cut) -> None:
        path = moment.path
        splats, kept = sum(len(p.field) for p in pieces), sum(int(cut.keeps(p.field).sum()) for p in pieces)
        submaps = int(path.submaps[-1]) + 1 if len(path) else 0
        facts = (
            f"**{moment.title}** ({moment.status})  \n{len(path)} frames, {len(path.keyframes)} keyframes, "
            f"{int(path.lost.sum())} lost, {submaps} submap{'s' * (submaps != 1)}  \n"
            f"{kept:,} of {splats:,} splats shown"
        )
        cut_text = "" if cut.most_sigma == float("inf") else f"hidden: σ above {cut.most_sigma:.3g}"
        self.panel.say(facts, cut_text, _frame_text(moment, wanted.row))

    def _follow(self, moment: Snapshot, wanted: Wanted) -> None:
        path = moment.path
        if wanted.follow and moment.live and len(path) and self._is_new("followed", Same(path)):
            for client in self.server.get_clients().values():
                look(client, path.T_world_camera[-1], BACK_M, UP_M)

    def _welcome(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self.changed())
        self.changed()

    def _clicked(self, row: int, client: viser.ClientHandle) -> None:
        moment = self._moment
        if moment is None or row >= len(moment.path):
            return
        self._go(client, row)
        try:
            picture = moment.picture(row)
        except SigmaSplatError as problem:
            self.panel.show_picture(f"frame {row}: {problem}", None)
            return
        nothing = "" if picture is not None else ": nobody kept what it saw"
        self.panel.show_picture(f"frame {row}{nothing}", picture)

    def _look_from(self, client: viser.ClientHandle) -> None:
        moment = self._moment
        if moment is not None and len(moment.path):
            self._go(client, min(self.panel.wanted().row, len(moment.path) - 1))

    def _go(self, client: viser.ClientHandle, row: int) -> None:
        """Send a browser where a frame was seen from, and clear the pictures before it out of the way."""
        moment = self._moment
        assert moment is not None
        self.panel.thumbnails.value = False
        look(client, moment.path.T_world_camera[row])
        self.changed()


def _frame_text(moment: Snapshot, row: int) -> str:
    """Say what the timeline's frame is."""
    path = moment.path
    if not len(path):
        return "no frame yet"
    row = min(row, len(path) - 1)
    kind = "lost" if path.lost[row] else "keyframe" if row in set(path.keyframes) else "tracked"
    return f"frame {row}: {kind}, submap {path.submaps[row]}"
