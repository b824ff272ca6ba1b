"""Say what to do after a run: repair what its scores show, then view and export the map."""

import shlex
from collections.abc import Iterator
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
        ("View the map in 3D, and measure distances:", f"sigmasplat view {path}"),
        ("Send the map to someone, as one page:", f"sigmasplat share {path} --out {name}.html"),
        ("Write a mesh for other programs:", f"sigmasplat mesh {path} --out {name}.glb"),
    ]


def advice(metrics: Metrics, again: str, settings: dict[str, Any]) -> list[Advice]:
    """Return what to repair, the most important first.

    again: the command that makes the run again; settings: the values of its config.json.
    """
    return [*_lost(metrics, again, settings), *_others(metrics, again, settings)]


def _lost(metrics: Metrics, again: str, settings: dict[str, Any]) -> Iterator[Advice]:
    stride, tracking = (settings.get("input") or {}).get("stride", 1), settings.get("tracking") or {}
    if not metrics.get("lost") or metrics.get("failure"):
        return
    if stride > 1:
        yield f"Tracking was lost, and the run used one image in {stride}. Use all images:", f"{again} --stride 1"
    elif not tracking.get("features", True):
        words = "Tracking was lost, and sparse features are off. They help where the camera moves fast:"
        yield words, f"{again} --set tracking.features=true"
    else:
        every = max((settings.get("mapping") or {}).get("every", 1) // 2, 1)
        yield (
            "Tracking was lost: the camera moved too fast, or saw only a bare wall. Map more often; if this does not "
            "help, record that part again and move more slowly.",
            f"{again} --set mapping.every={every}",
        )


def _others(metrics: Metrics, again: str, settings: dict[str, Any]) -> Iterator[Advice]:
    held_out, width = metrics.get("held_out") or {}, (settings.get("input") or {}).get("width", 0)
    if metrics.get("apart"):
        where = format_ranges(metrics.get("apart_frames") or [])
        yield (
            f"Images {where} are in separate maps, in components/. To connect them, record again, and after each "
            "interruption return to a place that was recorded before.",
            "",
        )
    psnr_db, covered, speed = held_out.get("psnr_db"), held_out.get("depth_coverage"), metrics.get("frames_per_s")
    if psnr_db is not None and psnr_db < PSNR_WORDS[1][0] and width:
        yield (
            f"Rendered images are blurred. The map was made from images {width} pixels wide; larger images give a "
            "sharper map, but take longer:",
            f"{again} --set input.width={2 * width}",
        )
    if covered is not None and covered <= 0.9:
        missing = number(1 - covered, 0, 100.0)
        yield f"{missing} % of the depth readings have no surface in the map. Scan these places again, more slowly.", ""
    if speed and speed < SLOW_PER_S:
        smaller = max((width or 640) * 3 // 4 // 16 * 16, 160)
        yield f"The run is slow: {rate(speed)}. Smaller images are faster:", f"{again} --set input.width={smaller}"
    if (metrics.get("submaps") or 1) >= 3 and not (metrics.get("loops") or {}).get("accepted"):
        yield "No loop was closed, so drift could not be corrected. End a scan where it started.", ""
    if metrics.get("calibration", "") is None and (settings.get("uncertainty") or {}).get("probes"):
        yield "The run has no predicted errors, because it did not make its final map. Make it again:", again
    elif metrics.get("calibration", "") is None:
        yield (
            "The run has no predicted errors of colour and depth, because it kept no probe views. Keep four in each "
            "submap; this does not change the map:",
            f"{again} --set uncertainty.probes=4",
        )
