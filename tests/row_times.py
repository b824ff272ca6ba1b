"""When the rows of an image were read: the definition that kernels are compared with."""

from sigmasplat.data.readout import Readout
from sigmasplat.types import Matrix


def depth_s(readout: Readout, row: Matrix, height: int) -> Matrix:
    """Return when the depth at some rows of an image was read, s after the middle of its colour."""
    late_s = readout.late_s + readout.times.depth_late_s
    return late_s + readout.times.depth_rows_s * ((row + 0.5) / height - 0.5)


def color_s(readout: Readout, row: Matrix, height: int) -> Matrix:
    """Return when the colour at some rows was read, as `depth_s`."""
    return readout.times.color_rows_s * ((row + 0.5) / height - 0.5)
