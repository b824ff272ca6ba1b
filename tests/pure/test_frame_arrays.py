"""Images in memory: numpy arrays and torch tensors of usual types become frames, all others are refused in a line."""

from typing import Any

import numpy as np
import pytest
import torch

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import frame_from_arrays
from sigmasplat.errors import ConfigError, SourceError

CAMERA = Camera(8, 6, 7.0, 7.5, 3.5, 2.5)
FOUR = (7.0, 7.5, 3.5, 2.5)
K = np.array([[7.0, 0, 3.5], [0, 7.5, 2.5], [0, 0, 1]])
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (6, 8, 3)).astype(np.uint8)
MILLIMETRES = RNG.integers(500, 4000, (6, 8)).astype(np.uint16)
MILLIMETRES[0, :3] = 0
METRES = (MILLIMETRES / 1000).astype(np.float32)


def frame(rgb: Any = RGB, depth: Any = METRES, k: Any = K, timestamp: Any = 0.5, **options: Any) -> Frame:
    return frame_from_arrays(rgb, depth, k, timestamp, **options)


def same(a: Frame, b: Frame) -> bool:
    return np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m) and a.camera == b.camera


def test_bytes_become_float_colour_and_metres_stay() -> None:
    f = frame(index=3)
    assert np.array_equal(f.color, (RGB / 255).astype(np.float32)) and np.array_equal(f.depth_m, METRES)
    assert (f.camera, f.timestamp_s, f.index) == (CAMERA, 0.5, 3)


COLORS = {
    "float32": (RGB / 255).astype(np.float32),
    "float64": RGB / 255,
    "mirrored twice": np.ascontiguousarray(RGB[:, ::-1])[:, ::-1],
    "columns first in memory": np.asfortranarray(RGB),
    "a part of a larger image": np.pad(RGB, ((1, 1), (2, 2), (0, 0)))[1:-1, 2:-2],
    "read-only": np.frombuffer(RGB.tobytes(), np.uint8).reshape(RGB.shape),
    "lists": (RGB / 255).tolist(),
    "torch bytes": torch.from_numpy(RGB.copy()),
    "torch float": torch.from_numpy(RGB / 255),
    "torch with a gradient": torch.from_numpy(RGB / 255).requires_grad_(),
    "torch, strided": torch.from_numpy(RGB.copy()).permute(2, 0, 1).contiguous().permute(1, 2, 0),
}


@pytest.mark.parametrize("kind", COLORS)
def test_colour_of_every_usual_kind_gives_the_same_frame(kind: str) -> None:
    f = frame(COLORS[kind])
    assert same(f, frame()) and f.color.dtype == np.float32 and f.color.flags.c_contiguous


def test_half_precision_is_accepted() -> None:
    rgb = torch.from_numpy(RGB / 255)
    for half in (rgb.half(), rgb.bfloat16(), (RGB / 255).astype(np.float16)):
        assert np.abs(frame(half).color - frame().color).max() < 0.004


def test_colour_in_the_order_of_opencv() -> None:
    bgr = np.ascontiguousarray(RGB[..., ::-1])
    assert same(frame(bgr, color_order="bgr"), frame())
    assert same(frame(bgr[..., ::-1]), frame()), "a view with negative strides"
    assert same(frame(torch.from_numpy(bgr).float() / 255, color_order="bgr"), frame(RGB / np.float32(255)))


DEPTHS = {
    "uint16": (MILLIMETRES, 1000),
    "int32": (MILLIMETRES.astype(np.int32), 1000.0),
    "torch int32": (torch.from_numpy(MILLIMETRES.astype(np.int32)), 1000),
    "float64 metres": (MILLIMETRES / 1000, None),
    "float32 millimetres": (MILLIMETRES.astype(np.float32), 1000),
    "torch metres": (torch.from_numpy(METRES).requires_grad_(), None),
    "big-endian": (MILLIMETRES.astype(">u2"), 1000),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_of_every_usual_kind_gives_the_same_frame(kind: str) -> None:
    depth, scale = DEPTHS[kind]
    assert same(frame(depth=depth, depth_scale=scale), frame())


def test_the_largest_16_bit_number_is_no_reading() -> None:
    depth = MILLIMETRES.copy()
    depth[3, 4] = 65535
    assert frame(depth=depth, depth_scale=1000).depth_m[3, 4] == 0


def test_intrinsics_of_every_usual_kind_give_the_same_camera() -> None:
    kinds = (CAMERA, FOUR, list(FOUR), np.array(FOUR), K, K.tolist(), K.reshape(-1), torch.from_numpy(K))
    assert [frame(k=kind).camera for kind in kinds] == [CAMERA] * len(kinds)


def test_times_of_every_usual_kind_are_seconds() -> None:
    kinds = (2, 2.0, np.float64(2), np.int64(2), torch.tensor(2.0))
    assert [frame(timestamp=kind).timestamp_s for kind in kinds] == [2.0] * len(kinds)


def test_the_callers_buffers_are_copied_and_stay_as_they_are() -> None:
    rgb, bytes_, depth = (RGB / 255).astype(np.float32), RGB.copy(), METRES.copy()
    before = [a.tobytes() for a in (rgb, bytes_, depth, K)]
    frames = frame(rgb, depth), frame(bytes_, depth)
    assert all(a.flags.writeable for a in (rgb, bytes_, depth, K))
    assert [a.tobytes() for a in (rgb, bytes_, depth, K)] == before
    rgb[:], bytes_[:], depth[:] = 0.5, 7, 9.0
    assert all(same(f, frame()) for f in frames)


def test_a_frame_leaves_the_arrays_it_is_made_from_writeable() -> None:
    color, depth = (RGB / 255).astype(np.float32), METRES.copy()
    f = Frame(0, 0.0, color, depth, CAMERA)
    assert color.flags.writeable and depth.flags.writeable
    assert not f.color.flags.writeable and not f.depth_m.flags.writeable


def test_a_frame_accepts_a_view_with_negative_strides() -> None:
    color = (RGB / 255).astype(np.float32)
    assert np.array_equal(Frame(0, 0.0, color[..., ::-1], METRES, CAMERA).color, color[..., ::-1])


def test_a_frame_refuses_other_types_and_colour_to_255() -> None:
    color = (RGB / 255).astype(np.float32)
    for bad in (RGB, color.astype(float), torch.from_numpy(color), None):
        with pytest.raises(SourceError, match=r"colour is .*; give numpy float32"):
            Frame(0, 0.0, bad, METRES, CAMERA)  # type: ignore[arg-type]
    with pytest.raises(SourceError, match="depth is ndarray float64"):
        Frame(0, 0.0, color, METRES.astype(float), CAMERA)  # type: ignore[arg-type]
    with pytest.raises(SourceError, match=r"divide by 255"):
        Frame(0, 0.0, RGB.astype(np.float32), METRES, CAMERA)


def with_value(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed[2, 3] = value
    return changed


COLOR = (RGB / 255).astype(np.float32)
REFUSED: list[tuple[str, dict[str, Any]]] = [
    (r"colour is None; give an array", {"rgb": None}),
    (r"colour is .*\[6, 8\]; .*numpy\.stack\(\[gray\] \* 3, axis=-1\)", {"rgb": RGB[..., 0]}),
    (r"colour is .*\[6, 8, 1\]; .*numpy\.stack\(\[gray\] \* 3, axis=-1\)", {"rgb": RGB[..., :1]}),
    (r"colour is .*\[6, 8, 4\]; .*rgb\[\.\.\., :3\]", {"rgb": np.dstack([RGB, RGB[..., 0]])}),
    (r"colour is ndarray .*\[3, 6, 8\]; .*rgb\.transpose\(1, 2, 0\)", {"rgb": RGB.transpose(2, 0, 1)}),
    (r"colour is .*\[3, 6, 8\]; .*rgb\.permute\(1, 2, 0\)", {"rgb": torch.from_numpy(RGB.transpose(2, 0, 1).copy())}),
    (r"colour is .*\[1, 6, 8, 3\]; give one image", {"rgb": RGB[None]}),
    (r"colour is .*\[0, 8, 3\]; give one image", {"rgb": RGB[:0]}),
    (r"colour is .*uint16.*; give uint8, or float", {"rgb": RGB.astype(np.uint16)}),
    (r"colour is .*bool.*; give uint8, or float", {"rgb": RGB > 100}),
    (r"colour is .*int64.*; give uint8, or float", {"rgb": torch.from_numpy(RGB.astype(np.int64))}),
    (r"colour is .*complex128.*; give numbers", {"rgb": RGB * 1j}),
    (r"colour is str; give numbers", {"rgb": "image.png"}),
    (r"colour is list, not an array", {"rgb": [[1, 2], [3]]}),
    (r"colour is from .* to 255; give float values in 0…1 \(divide by 255\)", {"rgb": with_value(COLOR * 254, 255)}),
    (r"colour is from -0\.5 to", {"rgb": with_value(COLOR, -0.5)}),
    (r"colour holds NaN", {"rgb": with_value(COLOR, np.nan)}),
    (r"color_order is 'gbr'; give 'rgb' or 'bgr'", {"color_order": "gbr"}),
    (r"depth is None; give an array", {"depth": None}),
    (r"depth is .*uint16.*, whole numbers; give depth_scale", {"depth": MILLIMETRES}),
    (r"depth is .*\[6, 8, 1\]; give one image \[H, W\]: depth\.squeeze\(\)", {"depth": METRES[..., None]}),
    (r"depth is .*\[1, 6, 8\]; give one image \[H, W\]", {"depth": METRES[None]}),
    (r"depth is .*\[6, 8, 3\]; give one image", {"depth": RGB}),
    (r"depth is .*uint8.*; 8 bits hold no metric depth", {"depth": RGB[..., 0], "depth_scale": 1000}),
    (r"the median depth is .* m; if it is in millimetres, give depth_scale=1000", {"depth": METRES * 1000}),
    (r"the median depth is .* m; correct depth_scale", {"depth": MILLIMETRES, "depth_scale": 1}),
    (r"the median depth is .* m; correct depth_scale", {"depth": MILLIMETRES, "depth_scale": 1e6}),
    (r"depth_scale is 0\.001; give the units per metre, at least 1", {"depth": MILLIMETRES, "depth_scale": 0.001}),
    (r"depth_scale is 0; give the units per metre", {"depth": MILLIMETRES, "depth_scale": 0}),
    (r"depth_scale is nan; give the units per metre", {"depth": METRES, "depth_scale": float("nan")}),
    (r"depth_scale is str; give the units per metre", {"depth": METRES, "depth_scale": "mm"}),
    (r"depth holds NaN or inf; write 0", {"depth": with_value(METRES, np.nan)}),
    (r"depth holds NaN or inf; write 0", {"depth": with_value(METRES.astype(float), 1e300)}),
    (r"depth is negative", {"depth": with_value(METRES, -1)}),
    (r"colour is \(6, 8, 3\), depth is \(3, 4\).*; register depth to colour", {"depth": METRES[::2, ::2]}),
    (r"colour is 8×6, but the camera is for 4×3", {"k": CAMERA.resized(4, 3)}),
    (r"K has the shape \[3, 4\]; give a 3×3 matrix or \(fx, fy, cx, cy\)", {"k": np.eye(3, 4)}),
    (r"K is not \[\[fx, 0, cx\], \[0, fy, cy\], \[0, 0, 1\]\]", {"k": K.T}),
    (r"K has fx = 0\.2 .* 8×6; give pixels .*, not normalised", {"k": (0.2, 0.2, 0.5, 0.5)}),
    (r"principal point at \(7, 5\), .* 8×4", {"k": (14.0, 15.0, 7.0, 5.0), "rgb": RGB[:4]}),
    (r"K is None", {"k": None}),
    (r"K is str; give numbers", {"k": "camera.yaml"}),
    (r"timestamp is 1\.7e\+18; give seconds .*divide nanoseconds by 1e9", {"timestamp": 1.7e18}),
    (r"timestamp is nan; give seconds", {"timestamp": float("nan")}),
    (r"timestamp is str; give seconds", {"timestamp": "noon"}),
    (r"timestamp is None; give seconds", {"timestamp": None}),
    (r"R_inertial_camera is not a rotation", {"R_inertial_camera": np.ones((3, 3))}),
]  # fmt: skip


@pytest.mark.parametrize(("message", "arguments"), REFUSED, ids=[message for message, _ in REFUSED])
def test_what_cannot_be_used_is_refused_with_the_remedy(message: str, arguments: dict[str, Any]) -> None:
    with pytest.raises(SourceError, match=message) as refused:
        frame(**arguments)
    assert "\n" not in str(refused.value)


def test_intrinsics_that_are_no_camera_are_refused() -> None:
    for bad in ((0.0, 7.0, 3.5, 2.5), (7.0, float("nan"), 3.5, 2.5)):
        with pytest.raises(ConfigError, match="not a camera"):
            frame(k=bad)


def test_a_camera_may_have_its_principal_point_outside_the_image() -> None:
    camera = Camera(8, 6, 7.0, 7.5, 20.0, 2.5)
    assert frame(k=camera).camera == camera


def test_an_image_without_readings_is_accepted() -> None:
    assert not frame(depth=np.zeros_like(METRES)).depth_m.any()
