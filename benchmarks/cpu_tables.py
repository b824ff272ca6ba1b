"""Tabulate the figures of the CPU benchmark: times, ratios, instruction sets, peers, goals."""

import math
from collections.abc import Iterator
from typing import Any

from tables import Section, significant

COLUMNS = (
    ("forward, all outputs", "forward_all"),
    ("colour + depth", "forward_color_depth"),
    ("forward + loss + pose gradient", "pose_only"),
    ("full backward", "backward"),
    ("mapping iteration", "mapping_iteration"),
    ("SSIM + gradient", "ssim"),
    ("reference of a keyframe", "keyframe_reference"),
    ("track, Gauss–Newton", "track_align"),
    ("track, Gauss–Newton + render", "track_align_map"),
    ("track, 60 Adam", "track_adam"),
)
TITLES = {work: title for title, work in COLUMNS}
GROWING = ("forward_all", "forward_color_depth", "pose_only", "backward", "mapping_iteration")
KITCHEN, LARGE = (77_000, 320), (300_000, 640)
GOALS_MS = (
    (KITCHEN, "forward_all", 6.5),
    (KITCHEN, "pose_only", 11.5),
    (KITCHEN, "mapping_iteration", 19.0),
    (KITCHEN, "track_align_map", 12.0),
    (KITCHEN, "ssim", 1.7),
    (LARGE, "forward_all", 27.0),
    (LARGE, "mapping_iteration", 80.0),
)
"""Issue 3's goals for two cores of an AVX-512 Xeon at 2.5 GHz."""
Figures = dict[str, Any]
Works = dict[str, dict[str, float]]


def main_works(scene: Figures) -> Works:
    """Return the times of a scene on the widest instruction set and all threads."""
    works: Works = scene["timings"][0]["works"]
    return works


def works_of(scene: Figures, isa: str, threads: int) -> Works | None:
    """Return a scene's times in one configuration, None if it was not measured."""
    found = [t["works"] for t in scene["timings"] if (t["isa"], t["threads"]) == (isa, threads)]
    return found[0] if found else None


def median_ms(works: Works | None, work: str) -> float | None:
    """Return the median of an operation, None if it was not timed."""
    return works[work]["median_ms"] if works and work in works else None


def ratio(above: float | None, below: float | None) -> float | None:
    """Divide two numbers; None if one is missing."""
    return above / below if above is not None and below else None


def exponent(cost: float, other_cost: float, size: float, other_size: float) -> float:
    """Return p of cost ∝ size^p through two measurements."""
    return math.log(other_cost / cost) / math.log(other_size / size)


def scene_of(figures: Figures, splats: int, width: int) -> Figures | None:
    """Find a scene by its size, None if it was not measured."""
    found = [s for s in figures["scenes"] if (s["splats"], s["width"]) == (splats, width)]
    return found[0] if found else None


def named(scene: Figures) -> str:
    """Name a scene by its size."""
    return f"{scene['splats'] / 1000:g} k, {scene['width']}×{scene['height']}"


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by cpu.py."""
    figures = measured["figures"]
    made = [times(figures), work_done(figures), goals(figures), ratios(figures), growth(figures), sets(figures)]
    return [s for s in [*made, plain_torch(figures), peers(figures)] if s.rows]


def times(figures: Figures) -> Section:
    """Tabulate the median of each operation by scene."""
    rows = [
        [named(s), *(significant(median_ms(main_works(s), work)) for _, work in COLUMNS)] for s in figures["scenes"]
    ]
    least = min((t["runs"] for s in figures["scenes"] for t in main_works(s).values()), default=0)
    first = figures["scenes"][0]["timings"][0] if figures["scenes"] else {"isa": "–", "threads": 0}
    how = f"{first['isa']}, {first['threads']} threads; medians of ≥ {least} runs"
    note = f"Splats from the depth of {figures['source']}, {how}."
    return Section("Times, ms", ["splats, image", *(title for title, _ in COLUMNS)], rows, note)


def work_done(figures: Figures) -> Section:
    """Tabulate the number of pairs in an image, the rate at which they are processed, and the memory used."""
    rows = []
    for s in figures["scenes"]:
        forward, millions = median_ms(main_works(s), "forward_all"), s["pairs"] / 1e6
        numbers = [1e6 * millions / s["splats"], ratio(millions, forward)]
        process = " → ".join(significant(s["memory"][when]) for when in ("before_mib", "peak_mib"))
        pairs = f"{significant(millions)} ± {significant(s['pairs_standard_error'] / 1e6, 1)}"
        rows.append([named(s), pairs, *(significant(x) for x in numbers), process])
    columns = ["splats, image", "pairs, M", "pairs per splat", "G pairs/s forward", "process, MiB"]
    pixels = figures["scenes"][0]["pairs_sampled_pixels"] if figures["scenes"] else 0
    pairs = f"Pairs of a pixel and a contributing splat, extrapolated from {pixels} random pixels (± standard error)"
    note = f"{pairs}. Process: peak memory after making the map, and after all operations."
    return Section("Work", columns, rows, note)


def goals(figures: Figures) -> Section:
    """Compare the times with the goals; scenes that were not measured are left out."""
    rows = []
    for (splats, width), work, goal_ms in GOALS_MS:
        scene = scene_of(figures, splats, width)
        value = median_ms(main_works(scene), work) if scene else None
        if scene and value is not None:
            text = f"{TITLES[work]}, {named(scene)}"
            rows.append([text, f"≤ {goal_ms:g} ms", significant(value), verdict(value <= goal_ms)])
    for text, value, bound, at_most in (*_ratio_goals(figures), *_growth_goals(figures)):
        if value is not None:
            held = value <= bound if at_most else value >= bound
            rows.append([text, f"{'≤' if at_most else '≥'} {bound:g}", significant(value), verdict(held)])
    return Section("Goals", ["figure", "goal", "measured", "reached"], rows)


def verdict(held: bool) -> str:
    """Write whether a goal is reached."""
    return "yes" if held else "**no**"


def _ratio_goals(figures: Figures) -> Iterator[tuple[str, float | None, float, bool]]:
    scene = scene_of(figures, *KITCHEN)
    if scene is None:
        return
    main, where = main_works(scene), named(scene)
    isa, threads = scene["timings"][0]["isa"], scene["timings"][0]["threads"]
    colour = ratio(median_ms(main, "forward_color_depth"), median_ms(main, "forward_all"))
    yield f"colour + depth / all outputs, forward, {where}", colour, 0.75, True
    if threads == 2:
        for title, work in (COLUMNS[0], COLUMNS[4]):
            single = median_ms(works_of(scene, isa, 1), work)
            yield f"1 → 2 threads, {title}, {where}", ratio(single, median_ms(main, work)), 1.75, False
    if isa == "avx512":
        for other, bound in (("avx2", 1.5), ("baseline", 2.3)):
            for title, work in (COLUMNS[0], COLUMNS[4]):
                slower = median_ms(works_of(scene, other, threads), work)
                yield f"{other} / avx512, {title}, {where}", ratio(slower, median_ms(main, work)), bound, True


def _growth_goals(figures: Figures) -> Iterator[tuple[str, float | None, float, bool]]:
    for text, work, value in _exponents(figures):
        if work in ("forward_all", "mapping_iteration"):
            yield f"exponent, {text}, {TITLES[work]}", value, 1.1, True


def ratios(figures: Figures) -> Section:
    """Tabulate ratios of the times of a scene."""
    rows = []
    for s in figures["scenes"]:
        main, first = main_works(s), s["timings"][0]
        one = works_of(s, first["isa"], 1) if first["threads"] > 1 else None
        of_all = median_ms(main, "forward_all")
        pairs = [
            ratio(median_ms(main, "forward_color_depth"), of_all),
            ratio(median_ms(main, "forward_color_depth"), median_ms(main, "forward")),
            *(ratio(median_ms(one, w), median_ms(main, w)) for w in ("forward_all", "backward", "mapping_iteration")),
            ratio(median_ms(main, "ssim_torch"), median_ms(main, "ssim")),
            ratio(median_ms(main, "track_adam"), median_ms(main, "track_align_map")),
        ]
        rows.append([named(s), *(significant(value) for value in pairs)])
    shares = ["colour + depth / all outputs", "colour + depth / with variance"]
    threads = ["1 → all threads, forward", "… backward", "… mapping"]
    columns = ["splats, image", *shares, *threads, "torch SSIM / ours", "60 Adam / Gauss–Newton + render"]
    return Section("Ratios", columns, rows)


def growth(figures: Figures) -> Section:
    """Tabulate the exponents of the growth of time with splats and with pixels."""
    found: dict[str, dict[str, float]] = {}
    for text, work, value in _exponents(figures):
        found.setdefault(text, {})[work] = value
    rows = [[text, *(significant(values.get(work)) for work in GROWING)] for text, values in found.items()]
    return Section("Growth, exponent", ["from → to", *(TITLES[work] for work in GROWING)], rows)


def _exponents(figures: Figures) -> Iterator[tuple[str, str, float]]:
    """Yield (from → to, work, exponent): fewest to most splats at each width, smallest to largest image at each map."""
    scenes = figures["scenes"]
    for key, other, size in (("width", "splats", _splats), ("splats", "width", _pixels)):
        for shared in sorted({s[key] for s in scenes}):
            line = sorted((s for s in scenes if s[key] == shared), key=lambda s: int(s[other]))
            if len(line) < 2:
                continue
            low, high = line[0], line[-1]
            for work in GROWING:
                costs = median_ms(main_works(low), work), median_ms(main_works(high), work)
                if costs[0] and costs[1]:
                    yield f"{named(low)} → {named(high)}", work, exponent(costs[0], costs[1], size(low), size(high))


def _splats(scene: Figures) -> float:
    return float(scene["splats"])


def _pixels(scene: Figures) -> float:
    return float(scene["width"] * scene["height"])


def sets(figures: Figures) -> Section:
    """Tabulate every instruction set and number of threads on one scene: that of the goals, otherwise the largest."""
    scene = scene_of(figures, *KITCHEN) or (figures["scenes"][-1] if figures["scenes"] else None)
    chosen = [(title, work) for title, work in COLUMNS if work != "track_adam"]
    columns = ["instruction set, threads", *(title for title, _ in chosen)]
    rows = [
        [f"{t['isa']}, {t['threads']}", *(significant(median_ms(t["works"], work)) for _, work in chosen)]
        for t in (scene["timings"] if scene else [])
    ]
    return Section("Instruction sets, ms", columns, rows, f"{named(scene)}." if scene else "")


def plain_torch(figures: Figures) -> Section:
    """Tabulate the plain-torch definition and the kernels on the same small input."""
    rows = [
        [f"{c['work']}, {named(c)}", significant(c["kernels"]["median_ms"]), significant(c["torch"]["median_ms"]),
         significant(ratio(c["torch"]["median_ms"], c["kernels"]["median_ms"]))]
        for c in figures["reference"]["compared"]
    ]  # fmt: skip
    note = "The definition computes every pair, even without a contribution; it exists for reading and testing."
    return Section("Plain torch", ["operation", "kernels, ms", "torch, ms", "ratio"], rows, note)


def peers(figures: Figures) -> Section:
    """Tabulate another rasteriser and our colour + depth on the same splats."""
    rows = []
    for s in (s for s in figures["scenes"] if s.get("peer")):
        ours, theirs = median_ms(main_works(s), "forward_color_depth"), s["peer"]["forward"]["median_ms"]
        difference = s["peer"]["mean_color_difference"]
        rows.append([f"{s['peer']['name']}, {named(s)}", significant(ours), significant(theirs),
                     significant(ratio(theirs, ours)), significant(difference, 2)])  # fmt: skip
    return Section("Peer", ["forward", "ours, ms", "theirs, ms", "ratio", "mean |difference| of colour"], rows)
