"""Say what to do after a run: repair what its scores show, then view and export the map."""

import shlex
from pathlib import PurePath
from typing import Any

from sigmasplat.api import format_ranges, number, rate

Metrics = dict[str, Any]
Advice = tuple[str, str]
"""What was found and what it means, and a command to try; the command may be empty."""
PSNR_WORDS = ((30.0, "very close to the camera images"), (25.0, "good"), (20.0, "recognisable, fine detail is blurred"))
SLOW_PER_S = 5.0
"""Below this number of images per second a run is slow."""


def next_commands(run: str) -> list[Advice]:
    """Return what can be done with any map."""
    path, name = shlex.quote(run), shlex.quote(PurePath(run).name)
    return [
        ("View the map in 3D, and hide uncertain splats:", f"sigmasplat view {path}"),
        ("Write the map for other viewers:", f"sigmasplat export {path} --out {name}.spz"),
        ("Write a mesh for other programs:", f"sigmasplat mesh {path} --out {name}.glb"),
    ]


def advice(metrics: Metrics, again: str, settings: dict[str, Any]) -> list[Advice]:
    """Return what to repair, the most important first.

    again: the command that makes the run again; settings: the values of its config.json.
    """
    return [found for rule in RULES if (found := rule(metrics, again, settings))]


def _lost(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if not metrics.get("lost") or metrics.get("failure"):
        return None
    stride = (settings.get("input") or {}).get("stride", 1)
    if stride > 1:
        words = f"Tracking was lost, and the run used one image in {stride}. Use all images:"
        return words, f"{again} --stride 1"
    tracking = settings.get("tracking") or {}
    if not tracking.get("features", True):
        words = "Tracking was lost, and sparse features are off. They help where the camera moves fast:"
        return words, f"{again} --set tracking.features=true"
    every = max((settings.get("mapping") or {}).get("every", 1) // 2, 1)
    return (
        "Tracking was lost: the camera moved too fast, or saw only a bare wall. Map more often; if this does not help, "
        "record that part again and move more slowly.",
        f"{again} --set mapping.every={every}",
    )


def _apart(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if not metrics.get("apart"):
        return None
    where = format_ranges(metrics.get("apart_frames") or [])
    return (
        f"Images {where} are in separate maps, in components/. To connect them, record again, and after each "
        "interruption return to a place that was recorded before.",
        "",
    )


def _blurred(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    psnr_db = (metrics.get("held_out") or {}).get("psnr_db")
    width = (settings.get("input") or {}).get("width", 0)
    if psnr_db is None or psnr_db >= PSNR_WORDS[1][0] or not width:
        return None
    return (
        f"Rendered images are blurred. The map was made from images {width} pixels wide; larger images give a sharper "
        "map, but take longer:",
        f"{again} --set input.width={2 * width}",
    )


def _holes(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    covered = (metrics.get("held_out") or {}).get("depth_coverage")
    if covered is None or covered > 0.9:
        return None
    missing = number(1 - covered, 0, 100.0)
    return f"{missing} % of the depth readings have no surface in the map. Scan these places again, more slowly.", ""


def _slow(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    speed, width = metrics.get("frames_per_s"), (settings.get("input") or {}).get("width", 0)
    if not speed or speed >= SLOW_PER_S:
        return None
    smaller = max((width or 640) * 3 // 4 // 16 * 16, 160)
    return (f"The run is slow: {rate(speed)}. Smaller images are faster:", f"{again} --set input.width={smaller}")


def _no_loop(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if (metrics.get("submaps") or 1) < 3 or (metrics.get("loops") or {}).get("accepted"):
        return None
    return "No loop was closed, so drift could not be corrected. End a scan where it started.", ""


def _no_prediction(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if "calibration" not in metrics or metrics["calibration"] is not None:
        return None
    if (settings.get("uncertainty") or {}).get("probes"):
        return "The run has no predicted errors, because it did not make its final map. Make it again:", again
    return (
        "The run has no predicted errors of colour and depth, because it kept no probe views. Keep four in each "
        "submap; this does not change the map:",
        f"{again} --set uncertainty.probes=4",
    )


RULES = (_lost, _apart, _blurred, _holes, _slow, _no_loop, _no_prediction)
"""What to check, the most important first."""
