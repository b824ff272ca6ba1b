"""Depth that a network of the user's predicts: what an ONNX file may look like, and what is refused."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depth_networks import BYTES, FLOAT, HALF, network, node, weighted
from paper_settings import InputConfig
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.plugins.predicted_depth import depth_model, source as predicted
from sigmasplat.plugins.predicted_depth.depth_model import DepthModel
from sigmasplat.plugins.sources import open_source

ROOM = "synthetic:frames=60,width=64,height=48"
PLAIN = InputConfig(depth_model_colors="unit")
WEIGHTS = np.array([1.0, 2.0, 4.0], np.float32)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of any size get images whose shorter side has 28 pixels, not 518."""
    monkeypatch.setattr(depth_model, "STEPS", ((14, 28), (32, 28)))


def image(height: int = 28, width: int = 42) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.float32) / np.float32(255.0)


def predicted_by(path: str, color: np.ndarray, settings: InputConfig = PLAIN) -> np.ndarray:
    found = DepthModel(Path(path), settings).predict(color)
    assert found.dtype == np.float32 and found.ndim == 2
    return found


@pytest.mark.parametrize(
    "shape",
    [(1, 3, 28, 42), (1, 3, "h", "w"), ("n", "c", "h", "w"), (1, 3, 28, "w"), (1, 3, None, 42), (None, 3, 28, 42)],
)
def test_colour_of_the_size_of_the_network_is_not_resized(tmp_path: Path, shape: tuple[int | str | None, ...]) -> None:
    color = image()
    np.testing.assert_allclose(predicted_by(weighted(tmp_path / "n.onnx", shape), color), color @ WEIGHTS, rtol=1e-5)


@pytest.mark.parametrize(
    ("numbers", "shape", "tolerance"),
    [(FLOAT, (1, 28, 42, 3), 1e-5), (HALF, (1, "h", "w", 3), 1e-2), (BYTES, (1, 28, 42, 3), 1e-5),
     (BYTES, (28, 42, 3), 1e-5), (FLOAT, ("h", "w", 3), 1e-5)],
)  # fmt: skip
def test_channels_last_half_precision_and_bytes(
    tmp_path: Path, numbers: int, shape: tuple[int | str, ...], tolerance: float
) -> None:
    nodes = [node("Cast", "image", "float", to=FLOAT), node("MatMul", "float weights", "depth")]
    path = network(tmp_path / "n.onnx", nodes, shape, constants={"weights": WEIGHTS}, numbers=numbers)
    color = image()
    expected = color @ WEIGHTS * (255.0 if numbers == BYTES else 1.0)
    np.testing.assert_allclose(predicted_by(path, color), expected, rtol=tolerance)


def test_a_network_without_an_axis_for_images_and_with_half_precision_output(tmp_path: Path) -> None:
    nodes = [node("ReduceMax", "image", "most", axes=[0], keepdims=0), node("Cast", "most", "depth", to=HALF)]
    path, color = network(tmp_path / "n.onnx", nodes, (3, 28, 42), out_numbers=HALF), image()
    np.testing.assert_allclose(predicted_by(path, color), color.max(-1), rtol=1e-3)


@pytest.mark.parametrize(
    ("colors", "least", "most"),
    [
        ("imagenet", (0 - np.array([0.485, 0.456, 0.406])) / [0.229, 0.224, 0.225], None),
        ("half", -np.ones(3), np.ones(3)),
        ("unit", np.zeros(3), np.ones(3)),
        ("bytes", np.zeros(3), np.full(3, 255.0)),
    ],
)
def test_the_numbers_that_a_network_expects(tmp_path: Path, colors: Any, least: np.ndarray, most: Any) -> None:
    color = np.zeros((28, 42, 3), np.float32)
    color[14:] = 1.0
    most = (1 - np.array([0.485, 0.456, 0.406])) / [0.229, 0.224, 0.225] if most is None else most
    found = predicted_by(weighted(tmp_path / "n.onnx"), color, replace(PLAIN, depth_model_colors=colors))
    np.testing.assert_allclose(found[[0, -1], 0], [least @ WEIGHTS, most @ WEIGHTS], rtol=1e-5)


def test_a_network_of_any_size_gets_multiples_of_14_or_of_the_32_that_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    color = image(480, 640)
    any_size = InputConfig()
    assert predicted_by(weighted(tmp_path / "14.onnx"), color, any_size).shape == (518, 686)
    assert predicted_by(weighted(tmp_path / "rows.onnx", (1, 3, 280, "w")), color, any_size).shape == (280, 378)
    halved = [node("MaxPool", "red", "small", kernel_shape=[32, 32], strides=[32, 32]),
              node("Resize", "small none scales", "large", mode="nearest"),
              node("Add", "red large", "depth")]  # fmt: skip
    first = node("Slice", "image zero one axis", "red")
    constants = {"zero": np.array([0]), "one": np.array([1]), "axis": np.array([1]), "none": np.zeros(0, np.float32),
                 "scales": np.float32([1, 1, 32, 32])}  # fmt: skip
    path = network(tmp_path / "32.onnx", [first, *halved], (1, 3, "h", "w"), constants=constants)
    assert predicted_by(path, color, any_size).shape == (384, 512)


def test_an_output_that_always_has_one_size_is_used(tmp_path: Path) -> None:
    nodes = [node("ReduceMean", "image", "gray", axes=[1]),
             node("Resize", "gray none none sizes", "depth", mode="linear")]  # fmt: skip
    constants = {"none": np.zeros(0, np.float32), "sizes": np.array([1, 1, 30, 40])}
    path = network(tmp_path / "n.onnx", nodes, (1, 3, "h", "w"), constants=constants)
    assert predicted_by(path, image()).shape == (30, 40)


def test_the_output_is_the_one_with_depth_in_its_name(tmp_path: Path) -> None:
    nodes = [node("ReduceMax", "image", "Predicted_Depth", axes=[1]), node("ReduceMin", "image", "other", axes=[1])]
    path, color = network(tmp_path / "n.onnx", nodes, (1, 3, "h", "w"), outputs=["other", "Predicted_Depth"]), image()
    np.testing.assert_array_equal(predicted_by(path, color), color.max(-1))
    unclear = network(tmp_path / "two.onnx", [*nodes[1:], node("ReduceMax", "image", "most", axes=[1])],
                      (1, 3, "h", "w"), outputs=["other", "most"])  # fmt: skip
    with pytest.raises(SourceError, match=r'not clear which output is depth \(other, most\); name one with "depth"'):
        predicted_by(unclear, color)


def test_depth_of_a_recording_is_that_of_its_colour_at_the_size_of_a_room_and_predicted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[np.ndarray] = []
    predict = DepthModel.predict
    monkeypatch.setattr(DepthModel, "predict", lambda self, color: seen.append(color) or predict(self, color))
    path, room = weighted(tmp_path / "n.onnx", (1, 3, 48, 64), bias=100.0), open_source(ROOM)
    source = open_source(ROOM, depth_model=path, depth_model_colors="unit", stride=2, limit=5)
    assert source.predicted_depth and source.camera == room.camera and len(source) == 5 and len(seen) == 1
    assert source.depth_model is not None and source.depth_model["file"] == "n.onnx"
    expected = [room.frame(i).color @ WEIGHTS + 100.0 for i in range(0, 10, 2)]
    factor = 2.0 / np.median(expected[0])
    for frame, depth in zip(source, expected, strict=True):
        np.testing.assert_allclose(frame.depth_m, factor * depth, rtol=1e-5)
        np.testing.assert_array_equal(source.depth_of(frame.index), frame.depth_m)
    assert len(seen) == 5
    monkeypatch.setattr(predicted, "MOST_KEPT_PIXELS", 2 * 48 * 64)
    few = open_source(ROOM, depth_model=path, depth_model_colors="unit")
    for i in (0, 1, 2, 2, 1, 0):
        few.depth_of(i)
    assert len(seen) == 5 + 4, "two are kept"


def test_inverse_depth(tmp_path: Path) -> None:
    path = weighted(tmp_path / "n.onnx", (1, 3, 24, 32), bias=-3.0)
    source = open_source(ROOM, depth_model=path, depth_model_colors="unit", predicted_inverse=True)
    depth, disparity = source.depth_of(0), predicted_by(path, open_source(ROOM).frame(0).color)
    assert depth.shape == (48, 64) and (depth[::2, ::2][disparity <= 0] == 0).all() and (disparity <= 0).any()
    product = (depth[::2, ::2] * disparity)[disparity > 0]
    np.testing.assert_allclose(product, product[0], rtol=1e-4)
    assert np.median(depth[depth > 0]) == pytest.approx(2.0, rel=1e-3)


def cut(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def external(path: Path) -> None:
    """Write a network whose weights are in another file."""
    import onnx

    model = onnx.load(str(path))
    onnx.save(model, str(path), save_as_external_data=True, location="weights.bin", size_threshold=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "cannot read .*n.onnx: No such file"),
        (lambda path: (path.unlink(), path.mkdir()), "Is a directory"),
        (lambda path: path.write_bytes(b""), "not a usable ONNX file"),
        (lambda path: path.write_bytes(b"<!DOCTYPE html>" * 40), "not a usable ONNX file"),
        (lambda path: cut(path, 60), "not a usable ONNX file"),
        (lambda path: path.write_bytes(path.read_bytes().replace(b"image", b"im\xb7ge")), "not a usable ONNX file"),
        (external, "its weights are in a second file.*; save it as one file"),
        (lambda path: weighted(path, inputs=["image", "K"]), r"has 2 inputs \(image, K\)"),
        (lambda path: weighted(path, inputs=["image", "\n" * 999]), r"has 2 inputs \(image, \?\?"),
        (lambda path: weighted(path, (4, 3, "h", "w")), "of shape 4×3×h×w; export it for one colour image"),
        (lambda path: weighted(path, (1, 3, 100_000, 100_000)), "the limit is 36 megapixels"),
        (lambda path: network(path, [node("Identity", "image", "depth")], (1, 1, "h", "w")), "of shape 1×1×h×w"),
        (lambda path: network(path, [node("Identity", "image", "depth")], (1, 1, 3, "h", "w")), "1×1×3×h×w"),
        (lambda path: network(path, [node("Identity", "image", "depth")], (1, 3, "h", "w"), numbers=7, out_numbers=7),
         r"is tensor\(int64\)"),
        (lambda path: network(path, [node("Identity", "image", "depth")], (1, 3, "h", 42)), "output depth is"),
        (lambda path: network(path, [node("ReduceMean", "image", "depth", axes=[2, 3])], (1, 3, 9, 9)), "not depth"),
        (lambda path: network(path, [node("Abs", "image", "a"), node("Neg", "image", "b")], (1, 3, "h", "w"),
                              outputs=["a", "b"]), r"it is not clear which output is depth \(a, b\)"),
        (lambda path: network(path, [node("MatMul", "image weights", "depth")], (1, 3, "h", "w"),
                              constants={"weights": np.ones((5, 5), np.float32)}), "the network fails for"),
        (lambda path: weighted(path, bias=float("nan")), "holds [0-9]+ NaN or inf pixels"),
        (lambda path: weighted(path, bias=-100.0), "no value above 0"),
    ],
)  # fmt: skip
def test_what_is_no_network_for_depth_is_refused_in_one_line(
    tmp_path: Path, change: Any, message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "n.onnx"
    weighted(path)
    change(path)
    with pytest.raises(SourceError, match=message) as found:
        open_source(ROOM, depth_model=str(path), depth_model_colors="unit")
    assert "\n" not in str(found.value) and len(str(found.value)) < 500
    assert capfd.readouterr() == ("", ""), "onnxruntime prints nothing"


def test_a_frame_for_which_the_network_fails_is_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(ROOM, depth_model=weighted(tmp_path / "n.onnx"), limit=4)
    predict, bad = DepthModel.predict, np.rint(open_source(ROOM).frame(2).color)
    monkeypatch.setattr(
        DepthModel,
        "predict",
        lambda self, color: predict(self, color) * (np.nan if (np.rint(color) == bad).all() else 1),
    )
    assert [frame.index for frame in source] == [0, 1, 3] and "NaN" in source.skipped[0]


def test_a_folder_and_a_network_exclude_each_other() -> None:
    with pytest.raises(ConfigError, match="exclude each other"):
        InputConfig(predicted_depth="a", depth_model="b.onnx")


def test_without_onnxruntime_the_line_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = weighted(tmp_path / "n.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SourceError, match=r"a depth model needs onnxruntime .*pip install 'sigmasplat\[onnx\]'"):
        open_source(ROOM, depth_model=path)
