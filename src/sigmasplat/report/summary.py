"""Say what scores mean, to somebody who was not there: what was made, how good it is, what to try next."""

from typing import TYPE_CHECKING, Any

from sigmasplat.report.tables import number

if TYPE_CHECKING:
    from sigmasplat.floorplan.floor_plan import FloorPlan

Metrics = dict[str, Any]
Advice = tuple[str, str]
"""What was noticed and what it means, and a command to try; the command may be empty."""

PICTURES = ((30.0, "hard to tell from the camera's"), (25.0, "good"), (20.0, "recognisable, fine detail blurred"))
RANKS = ((0.5, "well"), (0.3, "fairly well"), (0.1, "roughly"))
DEPTHS = ((0.01, "close"), (0.03, "good"))
FEW_DB = 3.0
"""Views the map was fitted to that look this much better than others say that there were too few of them."""
SLOW_PER_S = 5.0
"""Fewer images a second than this are slow."""


def summary_sentences(metrics: Metrics, machine: str = "") -> list[str]:
    """Return sentences about the whole run, the most important first."""
    return [
        _made(metrics, machine),
        _path(metrics),
        *_pictures(metrics),
        *_depth(metrics),
        *_uncertainty(metrics),
    ]


def _made(metrics: Metrics, machine: str) -> str:
    speed = metrics.get("frames_per_s")
    how = f", {number(speed, 1)} images a second" if speed else ""
    status = metrics.get("status")
    unfinished = (
        "" if status in (None, "complete") else f" The run is {status}: what follows is what there was by then."
    )
    return (
        f"{number(metrics.get('frames'), 0)} colour + depth images of {metrics.get('source')} became a path and "
        f"a map of {number(metrics.get('splats'), 0)} splats{how}{f' on {machine}' if machine else ''}.{unfinished}"
    )


def _path(metrics: Metrics) -> str:
    lost, ate = metrics.get("lost") or 0, metrics.get("ate") or {}
    followed = (
        f"The camera was lost on {lost} of {metrics.get('frames')} images; poses there are guesses."
        if lost
        else "The camera was followed all the way."
    )
    if ate.get("rmse_m") is None:
        return f"{followed} No true path is known, so that the path's error is not known either."
    before = (metrics.get("ate_odometry") or {}).get("rmse_m")
    told = before is not None and abs(before - ate["rmse_m"]) > max(0.1 * ate["rmse_m"], 1e-3)
    loops = f" Without its closed loops it would be off by {number(before, 1, 100.0)} cm." if told else ""
    error, worst = number(ate["rmse_m"], 1, 100.0), number(ate.get("max_m"), 1, 100.0)
    return f"{followed} Its path is off by {error} cm (root mean square), at worst by {worst} cm.{loops}"


def _pictures(metrics: Metrics) -> list[str]:
    psnr_db = (metrics.get("held_out") or {}).get("psnr_db")
    if psnr_db is None:
        return []
    said = next((words for least, words in PICTURES if psnr_db >= least), "poor")
    return [f"Pictures from places that the map was not fitted to come out at {number(psnr_db, 1)} dB PSNR: {said}."]


def _depth(metrics: Metrics) -> list[str]:
    held_out = metrics.get("held_out") or {}
    if held_out.get("depth_l1_m") is None:
        return []
    holes = 1.0 - (held_out.get("depth_coverage") or 0.0)
    missing = f" {number(holes, 0, 100.0)} % of what the camera measured is missing in the map." if holes > 0.02 else ""
    off_m = held_out["depth_l1_m"]
    said = next((words for most, words in DEPTHS if off_m <= most), "coarse")
    return [f"Its surfaces lie {number(off_m, 1, 100.0)} cm from the measured ones: {said}.{missing}"]


def _uncertainty(metrics: Metrics) -> list[str]:
    rank = (metrics.get("uncertainty") or {}).get("spearman")
    if rank is None:
        return []
    said = next((words for least, words in RANKS if rank >= least), "hardly")
    return [
        f"The map's own uncertainty V tells right pixels from wrong ones {said} (rank correlation {number(rank, 2)})."
    ]


def unsure(metrics: Metrics, plan: "FloorPlan | None") -> list[str]:
    """Return sentences about where the map should not be trusted: frames that were lost, and what a plan shows."""
    sentences = []
    lost = metrics.get("lost_frames") or []
    if lost:
        sentences.append(f"Do not trust what was seen around images {ranges(lost)}: the camera was lost there.")
    if plan is None:
        return sentences
    said = {"unseen": "never seen", "thin": "mapped thinly", "unsure": "mapped, but unsure"}
    areas = {why: [region.area_m2 for region in plan.regions if region.why == why] for why in said}
    parts = [f"{len(found)} {said[why]} ({number(sum(found), 1)} m²)" for why, found in areas.items() if found]
    if parts:
        sentences.append(f"Worth another visit, of the places that the path passes: {', '.join(parts)}.")
    return sentences


def ranges(indices: list[int], most: int = 4) -> str:
    """Write increasing indices as ranges: 3–5, 9."""
    runs: list[list[int]] = []
    for i in indices:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    words = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs[:most]]
    return ", ".join(words) + (", …" if len(runs) > most else "")


def advice(metrics: Metrics, run: str, again: str, settings: dict[str, Any]) -> list[Advice]:
    """Return what to try next; `run` is its folder, `again` the command that made it, `settings` its config.json."""
    found = [rule(metrics, again, settings) for rule in (_lost, _few_keyframes, _blurred, _holes, _slow, _no_loop)]
    use = ("Look at it from all sides, hide what is doubtful:", f"sigmasplat view {run}")
    surface = ("Make a surface for other programs:", f"sigmasplat mesh {run} --out room.glb")
    return [*filter(None, found), use, surface]


def _lost(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if not metrics.get("lost"):
        return None
    stride = (settings.get("input") or {}).get("stride", 1)
    if stride > 1:
        return f"The camera was lost, and only every {stride}th image was used: use them all.", f"{again} --stride 1"
    every = max((settings.get("mapping") or {}).get("every", 1) // 2, 1)
    return (
        "The camera was lost: it moved too fast, or looked at a bare wall. Map more often; if that does not help, "
        "record that part again, slower.",
        f"{again} --set mapping.every={every}",
    )


def _few_keyframes(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    training, held_out = (((metrics.get(kind) or {}).get("psnr_db")) for kind in ("training", "held_out"))
    every = (settings.get("mapping") or {}).get("every", 1)
    if training is None or held_out is None or training - held_out < FEW_DB or every < 2:
        return None
    return (
        f"Views that the map was fitted to look {number(training - held_out, 1)} dB better than others: use more.",
        f"{again} --set mapping.every={every // 2}",
    )


def _blurred(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    psnr_db = (metrics.get("held_out") or {}).get("psnr_db")
    width = (settings.get("input") or {}).get("width", 0)
    if psnr_db is None or psnr_db >= PICTURES[1][0] or not width:
        return None
    return (
        f"Pictures are blurred; the map was made from images {width} pixels wide. Larger ones are slower and sharper.",
        f"{again} --set input.width={2 * width}",
    )


def _holes(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    covered = (metrics.get("held_out") or {}).get("depth_coverage")
    if covered is None or covered > 0.9:
        return None
    return (
        f"{number(1 - covered, 0, 100.0)} % of what was measured is missing in the map: pass there again, slower.",
        "",
    )


def _slow(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    speed, width = metrics.get("frames_per_s"), (settings.get("input") or {}).get("width", 0)
    finish_s = metrics.get("finish_s") or 0.0
    if speed and finish_s > (frames_s := metrics["frames"] / speed):
        return _slow_to_finish(metrics["frames"], frames_s, finish_s, again, settings)
    if not speed or speed >= SLOW_PER_S:
        return None
    smaller = max((width or 640) * 3 // 4 // 16 * 16, 160)
    return (
        f"{number(speed, 1)} images a second is slow; smaller images are faster.",
        f"{again} --set input.width={smaller}",
    )


def _slow_to_finish(
    frames: int, frames_s: float, finish_s: float, again: str, settings: dict[str, Any]
) -> Advice | None:
    """Advise fewer steps of the final map where it took longer than the frames, and both together long."""
    steps = (settings.get("final") or {}).get("iterations", 0)
    if steps < 2 or frames / (frames_s + finish_s) >= SLOW_PER_S:
        return None
    return (
        f"The final map took {number(finish_s, 0)} s after {number(frames_s, 0)} s of frames; fewer steps are faster.",
        f"{again} --set final.iterations={steps // 2}",
    )


def _no_loop(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if (metrics.get("submaps") or 1) < 3 or (metrics.get("loops") or {}).get("accepted"):
        return None
    return "No place was seen twice, so that drift could not be taken out: end a scan where it began.", ""
