"""Write splats as Niantic's SPZ, version 3: 20 bytes per splat before compression.

Most current readers accept this version: nianticlabs/spz, splat-transform, three.js, Spark, Babylon.js.

A file is one gzip stream of a header of 16 bytes, then one stream for all splats of each kind of value: positions
(24-bit fixed point), opacities (0 to 255), colours (f_dc · 0.15 + ½, 0 to 255), log scales (steps of 1/16 from −10),
rotations (2 bits for the index of the largest of x, y, z, w, then sign and 9 bits of each other one), harmonics (steps
of 1/128, 128 is 0). Axes are x right, y up, z back: the writer rotates maps by 180° about x. Splats are in Morton
order, because similar neighbours compress better. The format cannot hold σ². Layout: nianticlabs/spz, load-spz.cc.
"""

import gzip
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
WRITTEN_VERSION = 3
FRACTIONAL_BITS = 12
STEPS_PER_M = 1 << FRACTIONAL_BITS
"""Positions have steps of a quarter of a millimetre up to 2 km from the origin."""
LARGEST_FIXED = (1 << 23) - 1
COLOR_SCALE = 0.15
LOG_SCALE_START, LOG_SCALE_STEPS = -10.0, 16.0
MAGNITUDES = (1 << 9) - 1


def write_field(path: Path, field: api.GaussianField) -> None:
    """Write the splats atomically. Raises RunError if the file cannot be written or a position is too large."""
    values = api.SplatValues.of(field).turned_about_x()
    values = values.ordered(api.morton_order(values.means))
    farthest_m = float(np.abs(values.means).max(initial=0.0))
    if not farthest_m * STEPS_PER_M <= LARGEST_FIXED:  # also if it is nan
        raise api.RunError(
            f"{path} cannot be written: a splat is {farthest_m:.3g} m from the origin, SPZ holds at most "
            f"{LARGEST_FIXED / STEPS_PER_M:.0f} m; the map is damaged, make it again"
        )
    colors = (values.colors - 0.5) / api.SH_C0 * COLOR_SCALE + 0.5
    streams = [
        np.round(values.means * STEPS_PER_M).astype("<i4")[..., None].view("u1")[..., :3].tobytes(),
        api.to_bytes(values.opacities * 255.0).tobytes(),
        api.to_bytes(colors * 255.0).tobytes(),
        api.to_bytes((values.log_scales - LOG_SCALE_START) * LOG_SCALE_STEPS).tobytes(),
        _packed_rotations(values.quats).tobytes(),
        api.to_bytes(np.round(values.harmonics * 128.0) + 128.0).tobytes(),
    ]
    header = HEADER.pack(MAGIC, WRITTEN_VERSION, len(values), values.degree, FRACTIONAL_BITS, 0, 0)
    with api.replacing(path) as temporary:
        temporary.write_bytes(gzip.compress(b"".join([header, *streams]), compresslevel=9, mtime=0))


def _packed_rotations(quats: api.Doubles) -> NDArray[np.uint32]:
    """Pack unit quaternions wxyz [N, 4] into words [N]."""
    which, others = api.smallest_three(np.roll(quats, -1, axis=1))
    word = which.astype("<u4")
    for part in others.T:
        magnitude = np.round(np.abs(part) / np.sqrt(0.5) * MAGNITUDES).astype(np.uint32)
        word = word << 10 | (part < 0.0).astype(np.uint32) << 9 | np.minimum(magnitude, MAGNITUDES)
    return word.astype("<u4")
