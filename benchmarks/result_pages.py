"""Say which results the pages in docs/results/ show, and how to read each; tables.py writes these pages.

Tables that no page shows stay in the JSON: those of single seeds and variants, and those that only verdicts read.
"""

from dataclasses import dataclass

import record


@dataclass(frozen=True)
class Shown:
    """Results on a page: their name, one sentence of meaning, and the tables shown (by title; none: all of them).

    without: columns left out, by their head, and rows left out, by their first cell. only: if given, the rows shown, by
    one of their first two cells.
    """

    name: str
    meaning: str
    tables: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    only: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """A page of results: its title, what it shows, and a block of `tables.WHOLE` that comes first, if any."""

    title: str
    shown: tuple[Shown, ...]
    first: str = ""


PAGES = {
    "path": Page(
        "Path, speed and memory",
        (
            Shown(
                "accuracy",
                "The default preset: path, speed without the final map, and held-out views of the final map.",
                ("Path and speed", "Map and uncertainty"),
                ("preset", "RPE, °", "… training", "NLL"),
            ),
            Shown(
                "realtime",
                "Frames arrive at 30 per second: the time from an image to its pose, and what real time costs.",
                without=("ATE, cm",),
            ),
            Shown(
                "paper-presets",
                "Presets of the papers with all their iterations, on small images: what they cost on a CPU.",
                without=("silently off", "lost", "splats, k", "ATE, cm", "final map, s"),
                only=("cgslam-tum", "cgslam-replica", "cgslam-loops-tum", "varsplat-tum", "varsplat-replica"),
            ),
            Shown(
                "board", "What changes since an earlier commit have done: one seed, no final map.",
                without=("frames", "hops, mm", "lost", "silent", "CPU, ms a frame"),
            ),
            Shown("variants", "Parts of recordings that a seed drew, beside the plain system.", ("By recording",)),
            Shown("loops", "Depth that drifts bends the path: what closing loops gains.", ("Goals",)),
        ),
    ),
    "map": Page(
        "Maps, meshes and exports",
        (
            Shown(
                "map-quality",
                "Held-out views of the final map and of the submaps it was made from, and the size of the map.",
                without=("before", "final map, s", "ATE, cm"),
            ),
            Shown(
                "full-resolution",
                "The last stage of the final map uses the camera's own images: it gains over enlarged working images.",
            ),
            Shown(
                "away_from_path",
                "Views up to 1 m off the path, and how many of their wrong pixels V declares.",
                without=("before",),
            ),
            Shown(
                "mesh-quality",
                "The mesh beside the depth of all frames fused by Open3D with the same poses.",
                without=("before", "ATE, mm", "precision, %", "recall, %"),
            ),
            Shown(
                "export-sizes",
                "What a smaller file costs in image quality (PSNR of held-out views, relative to the map's).",
                without=("PSNR, dB", "write, s", "read, s", "≤ 3 MB, ≥ 99%"),
            ),
            Shown(
                "first-look", "The viewer and a shared page in Chromium with software WebGL.",
                without=("splats", "phone, frames/s"),
            ),
            Shown("four-frames", "Geometry from four frames at true poses, scored at later frames.", only=("fitted",)),
            Shown(
                "consistency",
                "The parts of CG-SLAM, left out one at a time in rooms with noise.",
                ("Mean of scenes",),
            ),
        ),
    ),
    "uncertainty": Page(
        "Uncertainty",
        (
            Shown(
                "uncertainty",
                "How often an error lies within its predicted interval, before and after a run's own fit.",
                ("Coverage of predicted errors, final map",),
            ),
            Shown(
                "pose-covariance",
                "Whether the covariance of motions covers their errors.",
                without=("NEES, mean", "… median"),
                only=("50 frames",),
            ),
            Shown(
                "failure-probability",
                "The probability of a wrong pose, on disturbed recordings.",
                ("Tracked frames, without lost ones",),
            ),
            Shown(
                "uncertainty-weights",
                "The parts of the predicted variance and their shipped weights.",
                ("Weights fitted to all sequences",),
            ),
        ),
    ),
    "claims": Page(
        "Claims of the papers and weights by uncertainty",
        (
            Shown(
                "what-variance-is-good-for",
                "Poses in known maps, colour weighed by variances and by an oracle; σ² learned in several ways.",
                ("Recordings and room", "Ways to learn σ²"),
                ("NLL, best factor", "V, τ 3"),
            ),
        ),
        first="verdicts",
    ),
    "tracking": Page(
        "Tracking",
        (
            Shown(
                "tracking",
                "Alignment of images beside Adam through the renderer, from the same start.",
                ("Ratios",),
            ),
            Shown(
                "judge", "A pose is judged by one probability; each recording by a model without it.",
                ("Each recording by a model without it", "Stated and true, without the corridor"),
                ("lost: right, wrong, %", "not sure: right, wrong, %", "wrong", "poses"),
            ),
            Shown(
                "sensor-times", "Stamps of depth were moved, and found again without truth.", ("Depth moved in time",),
            ),
            Shown(
                "sensor-rooms", "A sensor measured without truth, in rooms with random faults.", ("Random rooms",),
            ),
            Shown(
                "relocalisation",
                "How often a lost camera is found from sparse features, and how often wrongly.",
                ("Whole map",),
            ),
            Shown(
                "robustness",
                "Three recordings used in development, disturbed in thirteen ways.",
                ("Suite",),
            ),
        ),
    ),
    "moving": Page(
        "Things that move",
        (
            Shown(
                "moving",
                "A ball moves through the synthetic room: masks, path and map.",
                without=("search", "lost frames", "left", "time, s"),
            ),
            Shown("composites", "The same ball, drawn into real recordings, with and without the search."),
            Shown(
                "moving-still", "Recordings in which nothing moves: what the search masks by mistake.",
                without=("lost frames", "splats"),
            ),
        ),
    ),
    "data": Page(
        "Other kinds of data",
        (
            Shown(
                "sensor-models",
                "What a model of the sensor's depth noise is worth in tracking.",
                ("Models of depth noise",),
            ),
            Shown("stereo", "Paths and depth from stereo pairs."),
            Shown("predicted", "Depth as a network may predict it, in the synthetic room."),
            Shown("given_poses", "Maps from known poses beside maps whose poses are tracked."),
        ),
    ),
    "kernels": Page(
        "Kernels",
        (
            Shown(
                "cpu",
                "Times of the renderer, of its gradients and of tracking, by size of map and image.",
                ("Times, ms", "Instruction sets, ms", "Plain torch"),
            ),
            Shown(
                "roofline",
                "Rates of the blend kernels beside the largest rates of one core.",
                ("Rates of one core",),
            ),
        ),
    ),
    "reliability": Page(
        "Long runs and faults",
        (
            Shown("long-live", "Half an hour in real time: what grows.", ("Growth",)),
            Shown("endurance", "Fifty minutes of frames at their own clock: what grows.", ("Growth",)),
            Shown("long-run", "Time and memory of one long recording.", ("Goals",)),
            Shown("viewer-memory", "What the viewer needs while a run goes on.", ("Memory",)),
            Shown("crashes", "Runs that are killed at random, or lose power, and are resumed.", only=("**all**",)),
            Shown("fuzz", "How commands end that read mutated files of every format.", only=("all 20000",)),
        ),
    ),
}  # fmt: skip
"""Pages by file name: docs/results/NAME.md."""

ON_A_GPU = (
    Shown("gpu", "Times of the CUDA backend, beside gsplat."),
    Shown("gpu-profile", "What one iteration asks of the device.", ("Iterations",)),
    *(Shown(f"gpu-{name}", "A run on CUDA.") for name in ("sigma", "varsplat-tum", "cgslam-tum")),
)
"""Results of flight.sh: on a page of their own as soon as there are any."""
if _flown := tuple(shown for shown in ON_A_GPU if record.latest(shown.name) is not None):
    PAGES["gpu"] = Page("On a GPU", _flown)


def anchor(name: str) -> str:
    """Return the anchor of the heading of results."""
    return name.lower()


def page_of(name: str) -> str | None:
    """Return the page that shows results of this name; None if no page does."""
    return next((page for page, made in PAGES.items() if name in (made.first, *(s.name for s in made.shown))), None)


def link(name: str, folder: str = "") -> str:
    """Return results' name, as a link if a page in `folder` shows them."""
    page = page_of(name)
    return name if page is None else f"[{name}]({folder}{page}.md#{anchor(name)})"
