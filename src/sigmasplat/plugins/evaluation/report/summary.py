"""Describe the scores of a run in sentences: three verdicts, the result."""

from collections.abc import Sequence
from typing import NamedTuple

from sigmasplat.api import format_ranges, number
from sigmasplat.plugins.evaluation.report.advice import PSNR_WORDS, Advice, Metrics

DEPTH_WORDS = ((0.01, "very accurate"), (0.03, "good"))
CALIBRATED = 0.05
"""Largest difference of a coverage from its nominal value that counts as calibrated."""


class Verdict(NamedTuple):
    """What is judged, how it is in a few words with the figure, and what that means; then a command to try, if any."""

    about: str
    words: str
    meaning: str
    command: str = ""


def verdicts(metrics: Metrics, unsure: Sequence[int], advice: Sequence[Advice]) -> list[Verdict]:
    """Return where the path is not sure, how good the map is, and what to do next.

    unsure: images whose pose is probably off by more than 5 cm; advice: what to repair, the most important first.
    """
    words, command = advice[0] if advice else ("The checks of the report found nothing to repair.", "")
    todo = Verdict("Next", "Try this" if advice else "Use the map", words, command)
    meaning = "" if metrics.get("failure") else _map(metrics)
    known = f"{path_words(metrics)}, {len(unsure)} of them doubtful" if unsure else path_words(metrics)
    path = _path(metrics, unsure) + _continued(metrics) + _pose_covariance(metrics)
    return [Verdict("Path", known, path), Verdict("Map", map_words(metrics), meaning), todo]


def path_words(metrics: Metrics) -> str:
    """Return how many images have a pose, and which ones do not."""
    frames, lost, apart = metrics.get("frames") or 0, metrics.get("lost") or 0, metrics.get("apart") or 0
    if not lost and not apart:
        return f"All {frames} images have a pose"
    where = format_ranges(sorted([*(metrics.get("lost_frames") or []), *(metrics.get("apart_frames") or [])]))
    return f"{lost + apart} of {frames} images have no pose{f' ({where})' if where else ''}"


def map_words(metrics: Metrics) -> str:
    """Return how good rendered images are."""
    found = (metrics.get(name) or {} for name in ("held_out", "training"))
    psnr_db = next((scores["psnr_db"] for scores in found if scores.get("psnr_db") is not None), None)
    if psnr_db is None or metrics.get("failure"):
        return "Not compared with images" if psnr_db is None else "Of a part of the images only"
    rating = next((words for least, words in PSNR_WORDS if psnr_db >= least), "poor")
    return f"{rating.capitalize()}: {number(psnr_db, 1)} dB PSNR"


def result_sentence(metrics: Metrics) -> str:
    """Return the result of a run as one sentence, for the terminal."""
    ate = {} if metrics.get("failure") else metrics.get("device_path") or metrics.get("ate") or {}
    error = f", the RMS {_compared(ate)} is {number(ate['rmse_m'], 1, 100.0)} cm" if ate else ""
    apart = f", of which {metrics['apart']} are in components/" if metrics.get("apart") else ""
    words = map_words(metrics)
    return f"{path_words(metrics)}{apart}{error}; the map is {words[0].lower()}{words[1:]}."


def _continued(metrics: Metrics) -> str:
    """Return whether the run is connected to the map of the earlier run that it continues."""
    if not metrics.get("onto"):
        return ""
    if not metrics.get("believed"):
        return f" It was never recognised in the map of {metrics['onto']}, so all of it is in components/."
    return f" It continues the map of {metrics['onto']}: poses are in the world of that run."


def _path(metrics: Metrics, unsure: Sequence[int]) -> str:
    """Return where the path is not sure, and its error if the true path is known."""
    ate = metrics.get("device_path") or metrics.get("ate") or {}
    doubtful = f" Probably off by more than 5 cm: images {format_ranges([*unsure])}." if unsure else ""
    tracked = f"{_tracked(metrics)}{doubtful}"
    if ate.get("rmse_m") is None:
        return f"{tracked} The error of the path is unknown, because the recording has no ground truth."
    before = (metrics.get("ate_odometry") or {}).get("rmse_m")
    differs = before is not None and abs(before - ate["rmse_m"]) > max(0.1 * ate["rmse_m"], 1e-3)
    loops = f" Without loop closure the RMS error is {number(before, 1, 100.0)} cm." if differs else ""
    error, largest = number(ate["rmse_m"], 1, 100.0), number(ate.get("max_m"), 1, 100.0)
    silent = (metrics.get("failures") or {}).get("silent") or 0
    undeclared = f" {silent} poses are off by more than 10 cm, but were not reported as lost." if silent else ""
    factor = metrics.get("path_scale")
    aligned = f" The scale is arbitrary: the path is aligned with scale factor {number(factor, 2)}." if factor else ""
    return (
        f"{tracked} The RMS {_compared(ate)} is {error} cm; the largest {_compared(ate).split()[0]} is {largest} cm."
        f"{aligned}{undeclared}{loops}"
    )


def _compared(ate: Metrics) -> str:
    return f"difference to the path of {ate['by']}" if "by" in ate else "error of the path"


def _tracked(metrics: Metrics) -> str:
    """Return whether tracking was lost, where it found its place again in the map, and which images are apart."""
    lost, again = metrics.get("lost") or 0, format_ranges(metrics.get("relocalised_frames") or [])
    found = f" It found its place in the map again at image {again}." if again else ""
    words = f"Tracking was lost on {lost} of {metrics.get('frames')} images, which have no pose.{found}"
    if not lost:
        found = f"No image was lost, but tracking had to find its place in the map again at image {again}."
        words = found if again else "Tracking was never lost."
    apart, components = metrics.get("apart") or 0, len(metrics.get("components") or [])
    maps = "a map of their own" if components == 1 else f"{components} maps of their own"
    sentence = f" {apart} images are in {maps}, which could not be connected to the first one (components/)."
    return words + sentence * bool(apart)


def _map(metrics: Metrics) -> str:
    """Return which images the words about the map are from, and how good its depth is."""
    held_out, words = metrics.get("held_out") or {}, list[str]()
    if held_out.get("psnr_db") is not None:
        words.append("Compared with images that the map was not made from.")
    elif (metrics.get("training") or {}).get("psnr_db") is not None:
        words.append("Compared with images that the map was made from, because none was held back.")
    if (error_m := held_out.get("depth_l1_m")) is not None:
        rating = next((words for most, words in DEPTH_WORDS if error_m <= most), "coarse")
        error = f"{number(error_m, 1, 100.0)} cm on average: {rating}."
        words.append(f"The depth of the map differs from the measured depth by {error}")
        holes = 1.0 - (held_out.get("depth_coverage") or 0.0)
        if holes > 0.02:
            words.append(f"{number(holes, 0, 100.0)} % of the depth readings have no surface in the map.")
    return " ".join(words)


def _pose_covariance(metrics: Metrics) -> str:
    """Return whether the covariance of poses has the right size; also with the truth's own error, if it is known."""
    covariance = metrics.get("pose_covariance") or {}
    found = covariance.get("windows")
    if not found:
        return ""
    off, factor = found["position_coverage_90"] - 0.9, found.get("position_k")
    size = "has the right size" if abs(off) <= CALIBRATED else f"is too {'small' if off < 0 else 'large'}"
    by = "" if factor is None or abs(off) <= CALIBRATED else f", in this recording by a factor of {number(factor, 1)}"
    words = (
        f" 90 % of the position errors over {covariance['window_frames']} frames should be within the covariance of "
        f"the poses: measured {number(found['position_coverage_90'], 0, 100.0)} %. It {size}{by}."
    )
    share = found.get("position_coverage_90_with_truth")
    if share is None:
        return words
    own = f"{number(covariance['truth_error_m'], 0, 1e3)} mm and {number(covariance['truth_error_deg'], 1)}° a pose"
    return f"{words} With the own error of the true path, {own}, {number(share, 0, 100.0)} % are within."
