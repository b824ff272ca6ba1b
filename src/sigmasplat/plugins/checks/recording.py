"""Inspect a recording before a run: format, size, depth and poses; problems that degrade the map, and their fixes."""

import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sigmasplat.api as api
from sigmasplat.api import Frame, InputConfig, Source, SourceError
from sigmasplat.plugins.checks.depth import EdgeAgreement, edge_agreement, overlay
from sigmasplat.plugins.checks.motion import MANY_HOLES, Motion, motion_warnings, rate, time_warnings, times_of
from sigmasplat.plugins.sources import open_source

SAMPLES, SMALL_PX = 16, 640
"""Frames that are kept for the checks, reduced to this width."""
SHOWN, SHEET_PX = 4, 240
"""Frames on the contact sheet, and the width of each of their pictures."""
USUAL_FOCAL = 0.9
"""Typical focal length of depth cameras, in image widths: a field of view of 58°. Enough to inspect, not to map."""
CONSECUTIVE = 300
"""Number of consecutive frames, in the middle of the recording, whose motion is checked."""
MANY_UNUSED = 0.05
"""If more than this share of the images is not used, warn."""
MAX_BRIGHTNESS_STEP = 0.2
"""If the median change of brightness between sampled frames is larger than this share, suggest `tracking.exposure`."""
FIRST, LOOKED_AT, ENOUGH_S = 150, 4, 0.5
"""Before a run, so many of the first frames are looked at, fewer if they are not read in this time."""


@dataclass(frozen=True, eq=False)
class Inspection:
    """Results: rows of (name, value), what is assumed and corrected, warnings with a fix, a contact sheet, and how well
    depth is registered."""

    title: str
    rows: list[tuple[str, str]]
    assumed: list[str]
    corrected: list[str]
    warnings: list[str]
    sheet: Image.Image
    agreement: EdgeAgreement | None

    def record(self) -> dict[str, Any]:
        """Return what was found as values for JSON."""
        return {"title": self.title, "found": dict(self.rows)} | {
            name: getattr(self, name) for name in ("assumed", "corrected", "warnings")
        }


def inspect_source(
    path: str | Path, settings: InputConfig, samples: int = SAMPLES, exposure: bool = False
) -> Inspection:
    """Open a recording and inspect `samples` frames, evenly spaced; exposure: whether a run will fit it. Raises
    SourceError if it cannot be opened."""
    name, (source, guessed) = api.format_name(path, settings), _opened(path, settings)
    first = max(0, (len(source) - CONSECUTIVE) // 2)
    consecutive, frames = range(first, min(first + CONSECUTIVE, len(source))), list[Frame]()
    sampled = api.evenly_spaced(len(source), samples).tolist()
    motion = Motion.of(_readable(source, sampled, consecutive, frames, source.skipped))
    if not frames:
        raise SourceError(f"{source.name}: none of {samples} sampled frames can be read; check the image files")
    agreement = _agreement(source, frames)
    times_s = times_of(source)
    warnings = [
        *guessed, *filter(None, [api.unlikely_camera(source.camera)]), *time_warnings(times_s),
        *_warnings(source, frames, settings, agreement, exposure), *motion_warnings(motion, first),
    ]  # fmt: skip
    rows = [
        ("format", name), *_size_rows(source, times_s), *_depth_rows(source, frames, settings),
        ("depth sensor", source.sensor or "unknown"),
        ("colour–depth alignment", "unknown: no outlines in depth" if agreement is None else agreement.sentence()),
        ("poses", source.described_truth() or "none: the error of the path cannot be measured"), *_imu_rows(frames),
        ("skipped", f"{len(source.skipped)} files (first: {source.skipped[0]})" if source.skipped else "nothing"),
        ("suggested preset", _suggested(name)),
    ]  # fmt: skip
    return Inspection(source.name, rows, source.assumptions, source.corrections, warnings, _sheet(frames), agreement)


def _opened(path: str | Path, settings: InputConfig) -> tuple[Source, list[str]]:
    """Open a recording. If its camera is unknown, use a typical one and warn."""
    try:
        return open_source(path, settings), []
    except api.CameraUnknown as problem:
        fx = round(USUAL_FOCAL * problem.size[0])
        return open_source(path, settings, fx=float(fx)), [f"{problem}; this inspection assumes fx = {fx} pixels"]


def first_look(source: Source) -> tuple[str, list[str]]:
    """Look at the first frames before a run: what they show, in one line, "" if none can be read; and warnings."""
    frames, started_s = list[Frame](), time.perf_counter()
    for i in api.evenly_spaced(min(FIRST, len(source)), LOOKED_AT).tolist():
        [*_readable(source, [i], (), frames, [])]
        if time.perf_counter() - started_s > ENOUGH_S:
            break
    if not frames:
        return "", []
    agreement = None if source.registrable and not source.depth_registered else _agreement(source, frames)
    warnings = [
        *filter(None, [api.unlikely_camera(source.camera), api.depth_warning(source, read=frames)]),
        *source.depth_doubts, *_registration_warnings(source, agreement),
    ]  # fmt: skip
    unit, readings = "" if source.predicted_depth else " m", _readings(frames)
    low, middle, high = np.percentile(readings, (1, 50, 99)) if len(readings) else (0.0, 0.0, 0.0)
    depth = f"depth {low:.2f} to {high:.2f}{unit}, median {middle:.2f}{unit}, {_holes(frames):.0%} without"
    light = f"brightness {np.mean([frame.color.mean() for frame in frames]):.0%}"
    aligned = f", on colour {agreement.sentence()}" if agreement and agreement.known else ""
    return f"looked at {len(frames)} of the first frames: {depth}, {light}{aligned}", warnings


def _agreement(source: Source, frames: list[Frame]) -> EdgeAgreement | None:
    return None if source.computed_depth else edge_agreement(frames)  # stereo depth has the left image's pixels


def _readable(
    source: Source, sampled: Collection[int], consecutive: Collection[int], kept: list[Frame], skipped: list[str]
) -> Iterator[Frame]:
    """Yield the consecutive frames, and keep the sampled ones, at most `SMALL_PX` wide; what is wrong with the sampled
    ones is added to `skipped`. Each frame is read once."""
    for i in sorted({*sampled, *consecutive}):
        try:
            frame = source.frame(i)
        except SourceError as problem:
            skipped += [str(problem)] * (i in sampled)
            continue
        width = min(SMALL_PX, frame.camera.width)
        frame = frame.resized(width, max(1, round(frame.camera.height * width / frame.camera.width)))
        if i in sampled:
            kept.append(frame)
        if i in consecutive:
            yield frame


def _readings(frames: list[Frame]) -> NDArray[np.float32]:
    return np.concatenate([frame.depth_m[frame.depth_m > 0] for frame in frames])


def _size_rows(source: Source, times_s: NDArray[np.float64]) -> list[tuple[str, str]]:
    count, camera = len(source), source.camera
    span_s = float(np.ptp(times_s)) if len(times_s) else 0.0
    times = f"{rate(times_s)} per second, {span_s:.1f} s" if span_s > 0 else "no times"
    return [
        ("frames", f"{count}, {times}"),
        ("size", f"{camera.width}×{camera.height} pixels"),
        ("camera", f"fx {camera.fx:.1f}, fy {camera.fy:.1f}, cx {camera.cx:.1f}, cy {camera.cy:.1f} pixels"),
    ]


def _depth_rows(source: Source, frames: list[Frame], settings: InputConfig) -> list[tuple[str, str]]:
    unit = f"{source.depth_units_per_metre:g} per metre" if source.depth_units_per_metre else "metres"
    camera = "same as colour, according to the recording"
    if source.depth_registered:
        camera = "separate; SigmaSplat registers depth to colour"
    elif source.registrable and settings.register_depth == "off":
        camera = "separate; depth is not registered (--register-depth off)"
    readings = _readings(frames)
    if not len(readings):
        return [("depth", "no depth reading in the sampled frames")]
    low, middle, high = np.percentile(readings, (1, 50, 99))
    scale = source.scene_scale
    used = ((readings >= settings.min_depth_m * scale) & (readings <= settings.max_depth_m * scale)).mean()
    return [
        ("depth unit", "arbitrary: a network predicted depth" if source.predicted_depth else unit),
        ("depth", f"{low:.2f} to {high:.2f} m, median {middle:.2f} m; {used:.0%} within the limits of the run"),
        ("without depth", f"{_holes(frames):.0%} of the pixels"),
        ("depth camera", camera),
    ] + [("your depth scale", f"it gives a median depth of {middle:.2f} m: is this plausible?")] * bool(
        settings.depth_scale
    )


def _imu_rows(frames: list[Frame]) -> list[tuple[str, str]]:
    """Return how many of the sampled frames have values of a gyroscope and of an accelerometer, no row if none has."""
    measured = {
        "gyroscope": sum(frame.R_inertial_camera is not None for frame in frames),
        "accelerometer": sum(frame.specific_force_m_s2 is not None for frame in frames),
    }
    return [(name, f"measured {n} of {len(frames)} sampled frames") for name, n in measured.items() if n]


def _holes(frames: list[Frame]) -> float:
    return float(np.mean([(frame.depth_m == 0).mean() for frame in frames]))


def _warnings(
    source: Source, frames: list[Frame], settings: InputConfig, agreement: EdgeAgreement | None, exposure: bool
) -> Iterator[str]:
    unused, every = len(source.skipped), len(source) + len(source.skipped)
    if unused > MANY_UNUSED * every:
        yield f"{unused} of {every} images are not used (first: {source.skipped[0]})"
    yield from (*filter(None, [api.depth_warning(source, read=frames)]), *source.depth_doubts)
    if _holes(frames) > MANY_HOLES:
        yield f"{_holes(frames):.0%} of the pixels have no depth; the map will have holes"
    max_depth_m = settings.max_depth_m * source.scene_scale
    beyond = np.mean([(frame.depth_m > max_depth_m).mean() for frame in frames])
    if beyond > 0.2:
        yield (
            f"{beyond:.0%} of the pixels are beyond {max_depth_m:g} m and are not used; "
            "to use them: --set input.max_depth_m=METRES"
        )
    yield from _registration_warnings(source, agreement)
    brightness = np.array([frame.color.mean() for frame in frames])
    mean = max(float(brightness.mean()), 1e-6)
    steps = np.abs(np.diff(brightness)) / mean
    if not exposure and len(steps) and float(np.median(steps)) > MAX_BRIGHTNESS_STEP:
        change = float(np.ptp(brightness) / mean)
        yield f"brightness changes by {change:.0%}; if exposure is automatic: --set tracking.exposure=true"


def _registration_warnings(source: Source, agreement: EdgeAgreement | None) -> list[str]:
    if agreement is None or agreement.registered:
        return []
    remedy = (
        "--register-depth on registers it"
        if source.registrable and not source.depth_registered
        else "give depth_camera and T_color_depth in calibration.json, or correct them"
    )
    return [f"depth is not registered to colour ({agreement.sentence()}); {remedy}"]


def _suggested(format_name: str) -> str:
    data_set = format_name.lower().split()[-1].replace("++", "pp")
    papers = [name for name in api.list_presets() if name.endswith(f"-{data_set}") and name.count("-") == 1]
    return api.default_preset() + (f" (settings of the papers, slow on CPUs: {', '.join(papers)})" if papers else "")


def _sheet(frames: list[Frame]) -> Image.Image:
    """Draw colour, depth, and the image with depth outlines, one row per frame."""
    from sigmasplat.plugins.outputs.drawing import colormap  # a run, which does not draw, starts 0.3 s earlier
    from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel, coloured, draw_view_strip

    chosen = api.evenly_spread(frames, SHOWN)
    depths = np.concatenate([frame.depth_m.reshape(-1) for frame in chosen])
    limits = colormap.value_range(depths, depths > 0)
    strips = [
        draw_view_strip([
            ViewPanel("colour", api.to_bytes(frame.color * 255.0), f"{frame.timestamp_s:.2f} s"),
            coloured("depth", frame.depth_m, frame.depth_m > 0, limits, colormap.VIRIDIS, " m"),
            ViewPanel("depth outlines", overlay(frame)),
        ], SHEET_PX)
        for frame in chosen
    ]  # fmt: skip
    return Image.fromarray(np.concatenate([np.asarray(strip) for strip in strips]))
