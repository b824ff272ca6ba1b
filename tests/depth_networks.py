"""Small networks as ONNX files, which compute depth from colour in a known way."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="onnx, which writes networks, is not installed")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
helper, numpy_helper = onnx.helper, onnx.numpy_helper
FLOAT, HALF, BYTES = onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.UINT8
OPSET = 17


def node(kind: str, inputs: str, output: str, **attributes: Any) -> Any:
    """Return an operator; `inputs` are names separated by spaces."""
    return helper.make_node(kind, inputs.split(), [output], **attributes)


def network(
    path: Path,
    nodes: Sequence[Any],
    shape: Sequence[int | str | None],
    *,
    constants: dict[str, Any] | None = None,
    outputs: Sequence[str] = ("depth",),
    inputs: Sequence[str] = ("image",),
    numbers: int = FLOAT,
    out_numbers: int = FLOAT,
) -> str:
    """Write a network of some operators, and return its path. The shapes of its outputs are not stated."""
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in (constants or {}).items()]
    graph = helper.make_graph(
        list(nodes),
        "depth",
        [helper.make_tensor_value_info(name, numbers, list(shape)) for name in inputs],
        [helper.make_tensor_value_info(name, out_numbers, None) for name in outputs],
        tensors,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return str(path)


def weighted(
    path: Path,
    shape: Sequence[int | str | None] = (1, 3, "h", "w"),
    bias: float = 0.0,
    weights: Sequence[float] = (1.0, 2.0, 4.0),
    **more: Any,
) -> str:
    """Write a network whose output is a weighted sum of red, green and blue, as it gets them, and bias [1, 1, H, W]."""
    constants = {"weights": np.array(weights, np.float32).reshape(1, 3, 1, 1), "bias": np.float32([bias])}
    return network(path, [node("Conv", "image weights bias", "depth")], shape, constants=constants, **more)
