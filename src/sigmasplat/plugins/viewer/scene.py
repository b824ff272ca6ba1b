"""Update viser's scene: nodes have fixed names and are changed in place or replaced, so their number is bounded."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
import viser

from sigmasplat.api import Camera, Matrix, se3
from sigmasplat.plugins.viewer.layers import SplatArrays
from sigmasplat.plugins.viewer.snapshot import Bytes, Opening, Segments

FRUSTUM_M = 0.08
LINE_PX, FRUSTUM_PX = {"path": 4.0, "truth": 2.0, "ruler": 3.0}, 1.0
KEYFRAME_COLOUR, CURRENT_COLOUR = (112, 120, 130), (255, 210, 60)
AHEAD_M = 1.0
"""Distance in front of a moved camera of the point that the mouse rotates it about."""

Clicked = Callable[[int, viser.ClientHandle], None]


class ViserScene:
    """The part of the scene that all browsers share."""

    def __init__(self, server: viser.ViserServer, clicked: Clicked) -> None:
        """Start with an empty scene; a click on a keyframe calls `clicked(row, client)`."""
        self.server, self.clicked = server, clicked
        self._splats: dict[str, viser.GaussianSplatHandle] = {}
        self._keyframes: dict[int, viser.CameraFrustumHandle] = {}
        self._marks: dict[str, Any] = {}
        server.scene.set_up_direction("-y")

    def show_splats(self, splats: Mapping[str, tuple[SplatArrays, Matrix]]) -> None:
        """Show exactly these pieces, by name, each at its T_world_piece."""
        drawn = {name: part for name, part in splats.items() if len(part[0].centers)}
        for name in self._splats.keys() - drawn.keys():
            self._splats.pop(name).remove()
        for name, (arrays, _) in drawn.items():
            if name in self._splats:
                self._splats[name].set_gaussians(*arrays)
            else:
                self._splats[name] = self.server.scene.add_gaussian_splats(f"/splats/{name}", *arrays)
        self.place_splats({name: T for name, (_, T) in drawn.items()})

    def place_splats(self, T_world_piece: Mapping[str, Matrix]) -> None:
        """Move the visible pieces to their poses."""
        for name, T in T_world_piece.items():
            if name in self._splats:
                _place(self._splats[name], T)

    def show_lines(self, name: Literal["path", "truth", "ruler"], segments: Segments | None) -> None:
        """Show line segments under a name, or remove them if None."""
        if segments is None or not len(segments.points):
            self._drop(name)
            return
        colors, width = srgb_to_linear(segments.colors), LINE_PX[name]
        self._marks[name] = self.server.scene.add_line_segments(
            f"/{name}", segments.points, colors, thickness=width, thickness_units="screen"
        )

    def show_label(self, text: str, position: Matrix | None) -> None:
        """Show the ruler's text at a position [3], or remove it if None."""
        self._drop("label")
        if position is not None:
            self._marks["label"] = self.server.scene.add_label("/label", text, position=position)

    def open_at(self, opening: Opening, first: bool) -> None:
        """Let browsers that are opened later begin with a view; the first one says where up is."""
        if first:
            self.server.scene.set_up_direction(opening.up)
        self.server.initial_camera.fov = opening.fov(opening.camera.width / opening.camera.height)
        move_camera(self.server.initial_camera, opening.T_world_camera, ahead_m=opening.ahead_m)

    def show_current_camera(self, camera: Camera, T_world_camera: Matrix | None) -> None:
        """Show the camera of the frame selected on the timeline, or remove it if None."""
        if T_world_camera is None:
            self._drop("current")
            return
        if "current" not in self._marks:
            self._marks["current"] = self._frustum("/current", camera, 1.5 * FRUSTUM_M, CURRENT_COLOUR)
        _place(self._marks["current"], T_world_camera)

    def show_keyframes(self, camera: Camera, T_world_camera: Mapping[int, Matrix]) -> None:
        """Show exactly the frusta of these keyframes, by row."""
        for row in tuple(self._keyframes.keys() - T_world_camera.keys()):
            self._keyframes.pop(row).remove()
        for row, T in T_world_camera.items():
            if row not in self._keyframes:
                frustum = self._frustum(f"/keyframes/{row}", camera, FRUSTUM_M, KEYFRAME_COLOUR)
                frustum.on_click(partial(self._pass_on, row))
                self._keyframes[row] = frustum
            _place(self._keyframes[row], T)

    def _frustum(
        self, name: str, camera: Camera, scale: float, color: tuple[int, int, int]
    ) -> viser.CameraFrustumHandle:
        fov = 2.0 * float(np.arctan(0.5 * camera.height / camera.fy))
        return self.server.scene.add_camera_frustum(
            name, fov, camera.width / camera.height, scale=scale, thickness=FRUSTUM_PX, thickness_units="screen",
            color=color, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _pass_on(self, row: int, event: viser.SceneNodePointerEvent[viser.CameraFrustumHandle]) -> None:
        self.clicked(row, event.client)

    def _drop(self, name: str) -> None:
        if name in self._marks:
            self._marks.pop(name).remove()


def move_camera(
    camera: viser.CameraHandle | viser.InitialCameraConfig, T_world_camera: Matrix, back_m: float = 0, up_m: float = 0,
    ahead_m: float = AHEAD_M,
) -> None:  # fmt: skip
    """Move a browser's camera, or that of pages opened later, to a pose, or to a position behind and above it."""
    camera.position = (T_world_camera @ np.array([0.0, -up_m, -back_m, 1.0]))[:3]
    camera.look_at = (T_world_camera @ np.array([0.0, 0.0, ahead_m, 1.0]))[:3]


def go_to_start(client: viser.ClientHandle, start: viser.InitialCameraConfig, opening: Opening | None) -> None:
    """Move a browser to where it should have opened: it may have reported another camera before it knew."""
    with client.atomic():
        client.camera.fov = start.fov if opening is None else opening.fov(client.camera.aspect)
        client.camera.position, client.camera.look_at = start.position, start.look_at


def camera_pose(camera: viser.CameraHandle) -> Matrix:
    """Return T_world_camera [4, 4] of a browser's camera."""
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion(camera.wxyz)
    T[:3, 3] = camera.position
    return T


def srgb_to_linear(colors: Bytes) -> Bytes:
    """Convert sRGB colours to linear ones, 0 to 255, which viser expects for lines."""
    return (255.0 * (colors / 255.0) ** 2.2).round().astype(np.uint8)


def _place(node: Any, T_world_node: Matrix) -> None:
    node.wxyz, node.position = se3.quaternion_from_rotation(T_world_node[:3, :3]), T_world_node[:3, 3]
