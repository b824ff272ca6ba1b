"""Run a network that predicts depth from colour: an ONNX file of the user's, through onnxruntime on the CPU."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.api import MOST_CHARACTERS, InputConfig, SourceError, cause, check_pixels, import_optional, read_bytes

Floats = NDArray[np.float32]
Size = tuple[int, int]
"""Height and width."""

MOST_BYTES = (1 << 31) - 1
"""Largest file: protobuf, the format of ONNX, has no larger messages."""
NUMBERS: Mapping[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}
CHANNELS = 3
MEAN, STD = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)
"""Of the colours of ImageNet, in [0, 1]."""
QUIET = 4
"""onnxruntime logs fatal errors only; all others are raised."""
LEAST_PX = 8
"""Shortest side of an image of depth."""
PREFIX = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ")


class Tensor(NamedTuple):
    """An input or output of a network: name, type as onnxruntime writes it, sizes of its axes (no number: any)."""

    name: str
    type: str
    shape: tuple[Any, ...]


STEPS = ((14, 518), (32, 384))
"""What networks of any size need: the sides of images are multiples of the first number, and the shorter side is about
the second one, pixels; for the ViT/14 family (Depth Anything), then for MiDaS, DPT and ZoeDepth."""


@dataclass(frozen=True)
class ImageInput:
    """The input of a network. batch: whether it has an axis before those of the image; channels_first: whether the axis
    of colour is before rows and columns; height, width: None if any size is allowed."""

    name: str
    numbers: type[np.generic]
    batch: bool
    channels_first: bool
    height: int | None
    width: int | None

    @classmethod
    def of(cls, path: Path, inputs: Sequence[Tensor]) -> "ImageInput":
        """Choose how to give an image to these inputs. Raises SourceError unless there is one, for a colour image."""
        if len(inputs) != 1:
            found = f"{len(inputs)} inputs ({_listed(each.name for each in inputs)})"
            raise SourceError(f"{path}: the network has {found}; export it with the image alone")
        (only,) = inputs
        shape = [size if isinstance(size, int) and size > 0 else None for size in only.shape]
        numbers, batch = NUMBERS.get(only.type), len(shape) == 4
        first, *middle, last = shape[batch:] if len(shape) in (3, 4) else (0, 0, 0)
        channels_first = first == CHANNELS or (first is None and last != CHANNELS)
        height, width = (*middle, last) if channels_first else (first, *middle)
        if numbers is None or not (channels_first or last == CHANNELS) or (batch and shape[0] not in (1, None)):
            found = _listed([f"{only.type} of shape {'×'.join(map(str, only.shape)) or 'unknown'}"])
            raise SourceError(
                f"{path}: the input of the network is {found}; export it for one colour image: "
                "1×3×H×W or 1×H×W×3, float32, float16 or uint8"
            )
        check_pixels(path, (width or 1, height or 1))
        return cls(only.name, numbers, batch, channels_first, height, width)

    def sizes(self, height: int, width: int) -> list[Size]:
        """Return the sizes (height, width) to try for an image, the first choice first."""
        if self.height and self.width:
            return [(self.height, self.width)]
        found = []
        for multiple, usual in STEPS:
            scale = usual / min(height, width)
            scale = self.height / height if self.height else self.width / width if self.width else scale
            rows, columns = (max(1, round(each * scale / multiple)) * multiple for each in (height, width))
            found.append((self.height or rows, self.width or columns))
        return found

    def tensor(self, color: Floats, size: Size, colors: str) -> NDArray[Any]:
        """Return colour [H, W, 3] in [0, 1] as the network takes it, at another size (height, width)."""
        values = _resized(color, *size)
        if self.numbers is np.uint8:
            values = np.rint(255.0 * values)
        elif colors == "imagenet":
            values = (values - MEAN) / STD
        elif colors == "half":
            values = 2.0 * values - 1.0
        elif colors == "bytes":
            values = 255.0 * values
        values = values.transpose(2, 0, 1) if self.channels_first else values
        values = values[None] if self.batch else values
        return np.ascontiguousarray(values, self.numbers)


class DepthModel:
    """A network that predicts depth, or inverse depth, from one colour image. The same image gives the same bytes.

    name, sha256: of the file. Raises SourceError if onnxruntime is missing, the file is not a usable ONNX file, or its
    network does not map one colour image to depth.
    """

    def __init__(self, path: Path, settings: InputConfig) -> None:
        data = read_bytes(path, most=MOST_BYTES)
        runtime = import_optional("onnxruntime", "onnx", f"{path}: a depth model")
        self.path, self.name, self.sha256 = path, path.name, hashlib.sha256(data).hexdigest()
        self._colors = settings.depth_model_colors
        with self._guarded("not a usable ONNX file", "export or download it again"):
            # From bytes: onnxruntime then reads no second file, and what runs is what was hashed. Its fallback only
            # prints and tries the same again.
            options, cpu = _options(runtime), ["CPUExecutionProvider"]
            self._session = runtime.InferenceSession(data, options, providers=cpu, enable_fallback=False)
            described = self._session.get_inputs(), self._session.get_outputs()  # copied: their text may be damaged
            inputs, outputs = ([Tensor(str(t.name), str(t.type), tuple(t.shape)) for t in each] for each in described)
        self._input = ImageInput.of(path, inputs)
        self._output = _chosen_output(path, outputs)
        self._size_of: dict[tuple[int, ...], Size] = {}

    def predict(self, color: Floats) -> Floats:
        """Return the prediction [h, w] for colour [H, W, 3] in [0, 1]; h and w are the network's. Raises SourceError if
        the network fails, or its output is not an image."""
        image = color.shape[:2]
        if image not in self._size_of:
            self._size_of[image], found = self._first(color)
            return found
        return self._run(color, self._size_of[image])

    def _first(self, color: Floats) -> tuple[Size, Floats]:
        """Try the sizes for an image. Return the first one whose output has the size of the input, otherwise the first
        one that works, and its output: a network may need multiples of 32, or always give one size."""
        found: list[tuple[Size, Floats]] = []
        problem: SourceError | None = None
        for size in self._input.sizes(*color.shape[:2]):
            try:
                found.append((size, self._run(color, size)))
            except SourceError as error:
                problem = problem or error
                continue
            if found[-1][1].shape == size:
                return found[-1]
        if problem and not found:
            raise problem
        return found[0]

    def _run(self, color: Floats, size: Size) -> Floats:
        check_pixels(self.path, size[::-1])
        tensor = self._input.tensor(color, size, self._colors)
        with self._guarded(f"the network fails for {size[1]}×{size[0]} pixels", "is it for colour images of any size?"):
            values = np.asarray(self._session.run([self._output], {self._input.name: tensor})[0])
        shape = tuple(side for side in values.shape if side != 1)
        if len(shape) != 2 or min(shape) < LEAST_PX or values.dtype.kind not in "uif":
            raise SourceError(
                f"{self.path}: output {_listed([self._output])} is {values.dtype} {values.shape}, not depth; export "
                "the network with one number for each pixel as its output"
            )
        check_pixels(self.path, shape[::-1])
        return values.reshape(shape).astype(np.float32)

    @contextmanager
    def _guarded(self, what: str, remedy: str) -> Iterator[None]:
        """Turn every exception of onnxruntime into a SourceError of one line: its classes have no common base."""
        try:
            yield
        except Exception as problem:
            text = PREFIX.sub("", cause(problem))
            if "xternal data" in text or "model_path must not be empty" in text:
                text, remedy = "its weights are in a second file", "save it as one file"
            raise SourceError(f"{self.path}: {what} ({text}); {remedy}") from problem


def _options(runtime: Any) -> Any:
    """Return the options of a session on one thread, whose results depend on nothing but its input."""
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = 1, 1
    options.execution_mode = runtime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = QUIET
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options


def _chosen_output(path: Path, outputs: Sequence[Tensor]) -> str:
    """Return the name of the only output, or of the only one with "depth" in its name. Raises SourceError if there is
    none."""
    names = [each.name for each in outputs]
    found = names if len(names) == 1 else [name for name in names if "depth" in name.lower()]
    if len(found) == 1:
        return found[0]
    raise SourceError(
        f'{path}: it is not clear which output is depth ({_listed(names)}); name one with "depth", or export it alone'
    )


def _listed(names: Iterable[str]) -> str:
    """Return names of an unknown file in one short line."""
    text = "".join(c if c.isprintable() else "?" for c in ", ".join(names)) or "none"
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]} …"


def _resized(color: Floats, height: int, width: int) -> Floats:
    """Return colour at another size, by cubic interpolation, as the networks were trained."""
    if color.shape[:2] == (height, width):
        return color
    planes = (Image.fromarray(np.ascontiguousarray(color[..., c])) for c in range(CHANNELS))
    resized = [np.asarray(plane.resize((width, height), Image.Resampling.BICUBIC)) for plane in planes]
    return np.asarray(np.clip(np.stack(resized, -1), 0.0, 1.0), np.float32)
