"""Read and write splats as OpenUSD's ParticleField3DGaussianSplat (26.03): .usda as text, .usdc and .usd as binary.

One prim, /map, with positions, orientations, scales (metres), opacities (0 to 1) and the harmonics of each splat from
degree 0 (which is (colour − ½)/C0) on, as float32. Our own attributes, which other readers skip: `primvars:sigma`, the
standard deviation of each colour channel; `primvars:depth_std_m` and `primvars:color_std` if they are known. The reader
ignores the last two. Unit is the metre. Axes are x right, y up, z back (`upAxis` Y): the writer rotates maps by 180°
about x, the reader rotates them back. The reader also reads z up. Layers that a file refers to are not read. Schema:
OpenUSD, UsdVol.
"""

import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sigmasplat.api import (
    DEGREES,
    SH_C0,
    Doubles,
    GaussianField,
    SigmaSplatError,
    SourceError,
    SplatStd,
    SplatValues,
    count,
    install_extra,
    log_scales_of,
    open_binary,
    replacing,
    rotations_of,
)

BINARY, TEXT = b"PXR-USDC", b"#usda"
SCHEMA = "ParticleField3DGaussianSplat"
COEFFICIENTS, DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"
EXTENT_SIGMAS = 3.0
"""A splat is assumed to end this many standard deviations from its centre."""


def write_field(path: Path, field: GaussianField, *, std: SplatStd | None = None) -> None:
    """Write the splats atomically: as text if the name ends in .usda, else as binary.

    `std` adds its two attributes. Raises SigmaSplatError without usd-core, RunError if the file cannot be written.
    """
    Sdf, Vt = _pxr("Sdf"), _pxr("Vt")
    values = SplatValues.of(field).turned_about_x()
    suffix = ".usda" if path.suffix.lower() == ".usda" else ".usdc"
    layer = Sdf.Layer.CreateAnonymous(suffix)
    layer.defaultPrim = "map"
    layer.pseudoRoot.SetInfo("upAxis", "Y")
    layer.pseudoRoot.SetInfo("metersPerUnit", 1.0)
    prim = Sdf.PrimSpec(layer, "map", Sdf.SpecifierDef, SCHEMA)
    names = Sdf.ValueTypeNames
    kinds = {
        "point": names.Point3fArray,
        "float3": names.Float3Array,
        "quat": names.QuatfArray,
        "float": names.FloatArray,
    }
    arrays = {"point": Vt.Vec3fArray, "float3": Vt.Vec3fArray, "quat": Vt.QuatfArray, "float": Vt.FloatArray}
    for name, kind, numbers in _attributes(values, field, std):
        attribute = Sdf.AttributeSpec(prim, name, kinds[kind])
        attribute.default = arrays[kind].FromNumpy(np.ascontiguousarray(numbers, np.float32))
        if name == COEFFICIENTS or name.startswith("primvars:"):
            attribute.SetInfo("interpolation", "vertex")
        if name == COEFFICIENTS:
            attribute.SetInfo("elementSize", 1 + count(values.degree))
    degree = Sdf.AttributeSpec(prim, DEGREE, names.Int, Sdf.VariabilityUniform)
    degree.default = values.degree
    with tempfile.TemporaryDirectory() as folder, replacing(path) as temporary:
        exported = Path(folder) / f"map{suffix}"
        layer.Export(str(exported))
        temporary.write_bytes(exported.read_bytes())


def read_field(path: Path) -> GaussianField:
    """Read the first ParticleField3DGaussianSplat of a file; without primvars:sigma, σ² becomes exp(−7).

    Raises SourceError if the file is missing or damaged, has no splats, or if they are moved; SigmaSplatError without
    usd-core.
    """
    layer, prim = _open(path)
    means = _numbers(prim, "positions", 3, path)
    quats = _numbers(prim, "orientations", 4, path)
    scales = _numbers(prim, "scales", 3, path)
    opacities = _numbers(prim, "opacities", 1, path)[:, 0]
    given = prim.attributes[DEGREE].default if DEGREE in _names(prim) else None
    degree = DEGREES if given is None else int(given)
    if not 0 <= degree <= DEGREES:
        raise SourceError(f"{path} has harmonics of degree {degree}; save it with degree 0 to 3")
    each = 1 + count(degree)
    coefficients = _numbers(prim, COEFFICIENTS, 3, path)
    sizes = (len(quats), len(scales), len(opacities), len(coefficients) / each)
    if any(size != len(means) for size in sizes):
        raise SourceError(f"{path} is damaged: its attributes have different numbers of splats")
    coefficients = coefficients.reshape(len(means), 3 * each)
    values = SplatValues(
        means,
        rotations_of(quats, path),
        log_scales_of(scales),
        np.clip(opacities, 1e-7, 1.0 - 1e-7),
        coefficients[:, :3] * SH_C0 + 0.5,
        coefficients[:, 3:],
    )
    z_up = layer.pseudoRoot.HasInfo("upAxis") and layer.pseudoRoot.GetInfo("upAxis") == "Z"
    sigmas = _numbers(prim, "primvars:sigma", 3, path) if "primvars:sigma" in _names(prim) else None
    if sigmas is not None and len(sigmas) != len(means):
        raise SourceError(f"{path} is damaged: primvars:sigma has {len(sigmas)} values for {len(means)} splats")
    field = (values if z_up else values.turned_about_x()).field(path, sigmas)
    return field.moved(torch.from_numpy(R_RDF_RFU)) if z_up else field


R_RDF_RFU = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Rotates axes x right, y ahead, z up to x right, y down, z ahead."""


def _pxr(name: str) -> Any:
    """Return a module of usd-core. Raises SigmaSplatError if it is not installed."""
    try:
        return import_module(f"pxr.{name}")
    except ImportError as problem:
        raise SigmaSplatError(
            f"OpenUSD needs usd-core ({problem}); install it with: {install_extra('usd')}"
        ) from problem


def _attributes(values: SplatValues, field: GaussianField, std: SplatStd | None) -> Iterator[tuple[str, str, Doubles]]:
    """Yield name, kind and values of the attributes."""
    reach = EXTENT_SIGMAS * np.exp(values.log_scales).max(1, keepdims=True)
    if len(values):
        yield "extent", "float3", np.stack([(values.means - reach).min(0), (values.means + reach).max(0)])
    yield "positions", "point", values.means
    yield "orientations", "quat", np.roll(values.quats, -1, axis=1)
    yield "scales", "float3", np.exp(values.log_scales)
    yield "opacities", "float", values.opacities
    coefficients = np.concatenate([(values.colors - 0.5) / SH_C0, values.harmonics], axis=1)
    yield COEFFICIENTS, "float3", coefficients.reshape(-1, 3)
    yield "primvars:displayColor", "float3", np.clip(values.colors, 0.0, 1.0)
    yield "primvars:sigma", "float3", field.variances.detach().cpu().double().sqrt().numpy()
    if std is not None:
        yield "primvars:depth_std_m", "float", std.depth_std_m.cpu().double().numpy()
        yield "primvars:color_std", "float", std.color_std.cpu().double().numpy()


def _open(path: Path) -> tuple[Any, Any]:
    """Return the layer and the prim of the splats. The layer must live as long as the prim. Raises SourceError."""
    Sdf, Tf = _pxr("Sdf"), _pxr("Tf")
    with open_binary(path, "cannot read map") as file:
        start = file.read(len(BINARY))
    suffix = ".usdc" if start == BINARY else ".usda"
    with tempfile.TemporaryDirectory() as folder:
        named = Path(folder) / f"map{suffix}"  # the format is chosen by the ending, which a map need not have
        named.symlink_to(path.resolve())
        try:
            layer = Sdf.Layer.OpenAsAnonymous(str(named))
        except Tf.ErrorException as problem:
            raise SourceError(f"{path} is damaged or truncated, or not OpenUSD") from problem
    if layer is None:
        raise SourceError(f"{path} is damaged or truncated, or not OpenUSD")
    prims = list(layer.rootPrims)
    while prims:
        prim = prims.pop(0)
        if any(name.startswith("xformOp") for name in _names(prim)):
            raise SourceError(f"{path} has a prim that is moved ({prim.path}); apply its transform before saving")
        if prim.typeName == SCHEMA:
            return layer, prim
        prims += list(prim.nameChildren)
    raise SourceError(f"{path} has no splats ({SCHEMA}), so it is not a map")


def _names(prim: Any) -> list[str]:
    return [attribute.name for attribute in prim.attributes]


def _numbers(prim: Any, name: str, width: int, path: Path) -> Doubles:
    """Return an attribute [N, width], of float or half precision. Raises SourceError if it is missing or not finite."""
    found = [prim.attributes[each].default for each in (name, f"{name}h") if each in _names(prim)]
    values = next((value for value in found if value is not None), None)
    if values is None:
        raise SourceError(f"{path} is damaged or not supported: it has no values of {name}")
    try:
        numbers = np.array(values, np.float64).reshape(-1, width)
    except (TypeError, ValueError) as problem:
        raise SourceError(f"{path} is damaged: {name} is not an array of {width} numbers each") from problem
    if not np.isfinite(numbers).all():
        raise SourceError(f"{path}: {name} has nan or inf")
    return numbers
