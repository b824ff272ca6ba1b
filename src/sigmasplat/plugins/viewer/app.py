"""Draw the newest snapshot of a run according to the controls, in one thread and at a bounded rate."""

import contextlib
import ctypes
import sys
import threading
from typing import Any

import numpy as np
import viser

from sigmasplat.api import Matrix, SigmaSplatError
from sigmasplat.plugins.outputs.drawing.colormap import INFERNO
from sigmasplat.plugins.viewer import layers, snapshot as lines
from sigmasplat.plugins.viewer.layers import Legend, ShownMap
from sigmasplat.plugins.viewer.motion import sway
from sigmasplat.plugins.viewer.panel import ControlPanel, escaped
from sigmasplat.plugins.viewer.ruler import Ruler
from sigmasplat.plugins.viewer.scene import ViserScene, camera_pose, go_to_start, move_camera
from sigmasplat.plugins.viewer.snapshot import BUDGET, Piece, Snapshot, within_budget

REST_S, LIVE_REST_S = 0.05, 0.5
"""Pause after each drawing, so that mouse moves do not keep the CPU busy and do not slow SLAM down."""
ROWS, LIVE_ROWS, SHARP_ROWS = 480, 240, 1080
"""Height in pixels of the images that SigmaSplat renders: of a finished run, of a live one, and of a finished run after
the view has been still for `STILL_S`, at most the height of the browser's window."""
STILL_S = 0.3
BACK_M, UP_M = 0.7, 0.25
"""Position of the following camera: behind and above the camera of the run."""


def release_memory() -> None:
    """Return freed memory to the operating system; does nothing where libc has no `malloc_trim`.

    Several threads repeatedly allocate arrays of tens of MB. glibc keeps the freed memory, which adds up to hundreds of
    MB within minutes.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class ViewerApp:
    """Shows snapshots in the browser. `show` and the controls only set a flag; a thread draws the newest snapshot."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.ruler = Ruler(server, self._shown_map, self._show_length)
        self.panel = ControlPanel(server, self.changed, self._look_from, self.ruler.start)
        self.scene = ViserScene(server, self._clicked)
        self._snapshot: Snapshot | None = None
        self._drawn: dict[Any, Any] = {}
        self._merged: tuple[Any, Any] = (None, None)
        self._wake, self._stop = threading.Event(), threading.Event()
        self._sharp, self._can_sharpen = False, False
        self._threads: list[threading.Thread] = []
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(lambda client: self._drawn.pop(("layer", client.client_id), None))
        floating = lambda: bool(self.panel.floating.value) and self.panel.layer is None  # noqa: E731
        stop_floating = lambda: setattr(self.panel.floating, "value", False)  # noqa: E731
        for work in (self._work, lambda: sway(server, floating, stop_floating, self._stop)):
            self._threads.append(threading.Thread(target=work, name="viewer", daemon=True))
            self._threads[-1].start()

    def show(self, snapshot: Snapshot) -> None:
        """Show a snapshot from now on; returns immediately."""
        first, self._snapshot = self._snapshot is None, snapshot
        self._open(snapshot, first)
        self.changed()

    def changed(self) -> None:
        """Ask the thread to redraw what has changed."""
        self._wake.set()

    def stop(self) -> None:
        """End the threads; the server keeps running."""
        self._stop.set()
        self._wake.set()
        for thread in self._threads:
            thread.join()

    def _work(self) -> None:
        trimmed: Snapshot | None = None
        while True:
            self._sharp = not self._wake.wait(STILL_S if self._can_sharpen else None)
            if self._stop.is_set():
                return
            self._wake.clear()
            self._can_sharpen = False
            snapshot = self._snapshot
            if snapshot is not None:
                try:
                    self._draw(snapshot)
                    if snapshot is not trimmed:
                        trimmed = snapshot
                        release_memory()
                except Exception as problem:  # an error in the viewer must not end the run
                    print(f"viewer: {type(problem).__name__}: {problem}", file=sys.stderr)
                self._stop.wait(LIVE_REST_S if snapshot.live else REST_S)

    def _draw(self, snapshot: Snapshot) -> None:
        panel = self.panel
        panel.adapt(len(snapshot.path), snapshot.live, snapshot.true_positions is not None)
        pieces = snapshot.visible_pieces(panel.row.value)
        known = len(pieces) == 1 and pieces[0].uncertainty is not None  # as `layers.merged`
        unit = " m" * any(piece.depth_std_m is not None for piece in pieces)
        panel.offer(known, any(piece.sure is not None and not piece.sure.all() for piece in pieces))
        span = layers.palette_range(pieces, panel.unsure.value) if panel.colouring.value == "how unsure" else None
        with self.server.atomic():
            self._draw_path(snapshot)
            self._draw_splats(pieces, span)
        self._draw_keyframes(snapshot)
        self._show_texts(snapshot, pieces)
        self._follow(snapshot)
        legend = None if span is None or panel.layer else Legend(INFERNO, *span, unit)
        for client in self.server.get_clients().values():
            legend = self._draw_layer(client, snapshot, pieces) or legend
        if self._is_new("legend", legend and legend[1:]):
            self.panel.show_legend(None if legend is None else layers.draw_legend(legend))

    def _is_new(self, what: Any, state: Any) -> bool:
        """Return whether something was not drawn in this state before, and remember the state. Snapshots, paths and
        fields are equal only to themselves."""
        if what in self._drawn and self._drawn[what] == state:
            return False
        self._drawn[what] = state
        return True

    def _open(self, snapshot: Snapshot, first: bool) -> None:
        """Choose the view of browsers that are opened from now on: the best one, or behind the newest camera."""
        inside = snapshot.path.T_world_camera[snapshot.path.inside]
        if snapshot.opening is not None:
            self.scene.open_at(snapshot.opening, first)
        elif len(inside):
            move_camera(self.server.initial_camera, inside[-1], BACK_M, UP_M)
        for client in self.server.get_clients().values() if first else ():
            go_to_start(client, self.server.initial_camera, snapshot.opening)

    def _draw_path(self, snapshot: Snapshot) -> None:
        path, row, shown = snapshot.path, self.panel.row.value, self.panel.path.value
        if self._is_new("path", (path, row, shown)):
            self.scene.show_lines("path", lines.path_segments(path, row) if shown else None)
            at = min(row, len(path) - 1)
            current = path.T_world_camera[at] if shown and len(path) and path.inside[at] else None
            self.scene.show_current_camera(snapshot.camera, current)
        truth = snapshot.true_positions if self.panel.true_path.value else None
        if self._is_new("true path", truth is not None and snapshot):
            self.scene.show_lines("truth", None if truth is None else lines.truth_segments(truth))

    def _draw_splats(self, pieces: tuple[Piece, ...], span: tuple[float, float] | None) -> None:
        if self.panel.layer is not None:
            pieces = ()
        state = ([(p.name, p.field) for p in pieces], span, unsure := self.panel.unsure.value)
        if self._is_new("splats", state):
            sent = within_budget(pieces, BUDGET)  # a large final map is rendered completely, but sent thinned
            self.scene.show_splats({p.name: (layers.splat_arrays(p, span, unsure), p.T_world_piece) for p in sent})
        else:
            self.scene.place_splats({piece.name: piece.T_world_piece for piece in pieces})

    def _draw_keyframes(self, snapshot: Snapshot) -> None:
        path, row, shown = snapshot.path, self.panel.row.value, self.panel.keyframes.value
        if self._is_new("keyframes", (path, row, shown)):
            rows = lines.keyframes_to_show(path, row) if shown else ()
            self.scene.show_keyframes(snapshot.camera, {row: path.T_world_camera[row] for row in rows})

    def _draw_layer(self, client: viser.ClientHandle, snapshot: Snapshot, pieces: tuple[Piece, ...]) -> Legend | None:
        """Render the selected layer from a browser's viewpoint as the background of its scene; return its legend."""
        key, c, layer = ("layer", client.client_id), client.camera, self.panel.layer
        if layer is None:
            if self._drawn.pop(key, None) is not None:
                client.scene.set_background_image(None)
            return None
        pose, shown = camera_pose(c), self._merge(snapshot, pieces)
        state = (layer, pose.tobytes(), c.fov, c.aspect, shown.field)
        drawn, rows = self._drawn.get(key), LIVE_ROWS if snapshot.live else ROWS
        sharp_rows = rows if snapshot.live else max(rows, min(SHARP_ROWS, c.image_height))
        rows = sharp_rows if self._sharp else rows
        if drawn is None or drawn[0] != state or drawn[2] < rows:
            made = layers.render_layer(shown, layers.browser_camera(c.fov, c.aspect, rows), pose, layer)
            if client.client_id not in self.server.get_clients():
                return None  # the client has disconnected in the meantime
            client.scene.set_background_image(made.pixels, "jpeg", jpeg_quality=85)
            drawn = self._drawn[key] = (state, made.legend, rows)
        self._can_sharpen |= drawn[2] < sharp_rows
        legend: Legend | None = drawn[1]
        return legend

    def _merge(self, snapshot: Snapshot, pieces: tuple[Piece, ...]) -> ShownMap:
        """Return the shown splats as one field, the same object until they change."""
        splats = ([(p.field, p.T_world_piece.tobytes()) for p in pieces], unsure := self.panel.unsure.value)
        if self._merged[0] != splats:
            self._merged = splats, layers.merged(pieces, unsure, snapshot.options, snapshot.backend)
        shown: ShownMap = self._merged[1]
        return shown

    def _shown_map(self) -> ShownMap | None:
        snapshot = self._snapshot
        return None if snapshot is None else self._merge(snapshot, snapshot.visible_pieces(self.panel.row.value))

    def _show_length(self, points: list[Matrix], text: str) -> None:
        """Draw the ruler between the points that were clicked so far, none to two."""
        ends = np.array([[points[0], points[-1]]] if points else np.empty((0, 2, 3)), np.float32)
        self.scene.show_lines("ruler", lines.Segments(ends, np.full(ends.shape, 255, np.uint8)))
        self.scene.show_label(text if len(points) > 1 else "first point", np.mean(points, axis=0) if points else None)
        self.panel.length.content = text

    def _show_texts(self, snapshot: Snapshot, pieces: tuple[Piece, ...]) -> None:
        path = snapshot.path
        splats = sum(len(p.field) for p in pieces)
        kept = sum(int(layers.shown(p, self.panel.unsure.value).sum()) for p in pieces)
        submaps = int(path.submaps[-1]) + 1 if len(path) else 0
        outside = int((~path.inside & ~path.lost).sum())
        apart = f", {outside} apart (not shown)" if outside else ""
        title, status = escaped(snapshot.title), escaped(snapshot.status)
        facts = (
            f"**{title}** ({status})  \n{len(path)} frames, {len(path.keyframes)} keyframes, "
            f"{int(path.lost.sum())} lost{apart}, {submaps} submap{'s' * (submaps != 1)}  \n"
            f"{kept:,} of {splats:,} splats shown"
        )
        self.panel.facts.content, self.panel.frame.content = facts, _frame_text(snapshot, self.panel.row.value)

    def _follow(self, snapshot: Snapshot) -> None:
        path = snapshot.path
        if self.panel.follow.value and snapshot.live and len(path) and self._is_new("followed", path):
            for client in self.server.get_clients().values():
                with client.atomic():
                    move_camera(client.camera, path.T_world_camera[-1], BACK_M, UP_M)

    def _welcome(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self.changed() if self.panel.layer else None)  # the browser draws the rest
        if self._snapshot is not None:
            go_to_start(client, self.server.initial_camera, self._snapshot.opening)
        self.changed()

    def _clicked(self, row: int, client: viser.ClientHandle) -> None:
        snapshot = self._snapshot
        if snapshot is None or row >= len(snapshot.path):
            return
        self._go(client, row)
        image, missing = None, "its image was not kept"
        try:
            image = snapshot.image(row)
        except SigmaSplatError as problem:
            missing = escaped(str(problem))
        self.panel.show_image(f"frame {row}" if image is not None else f"frame {row}: {missing}", image)

    def _look_from(self, client: viser.ClientHandle) -> None:
        self._go(client, self.panel.row.value)

    def _go(self, client: viser.ClientHandle, row: int) -> None:
        """Move a browser's camera to the pose of a frame, or to that of the last one."""
        if self._snapshot is not None and len(self._snapshot.path):
            with client.atomic():
                move_camera(client.camera, self._snapshot.path.T_world_camera[: row + 1][-1])
            self.changed()


def _frame_text(snapshot: Snapshot, row: int) -> str:
    """Describe the frame selected on the timeline."""
    path = snapshot.path
    if not len(path):
        return "no frame yet"
    row = min(row, len(path) - 1)
    apart = "" if path.inside[row] else ", not connected to the world"
    kind = "lost" if path.lost[row] else "keyframe" if row in set(path.keyframes) else "tracked"
    return f"frame {row}: {kind}, submap {path.submaps[row]}{apart}"
