"""The runs of same_bytes.py, and the names in them that an earlier commit has otherwise.

All are short. Recordings run with the default preset, most without final map and uncertainty; presets with published
numbers of iterations run with few, on small images.
"""

PLAIN = ("final.iterations=0", "uncertainty.probes=0")
FEW = (
    "input.width=160", "input.crop_px=4", "mapping.first_iterations=20", "mapping.iterations=8",
    "tracking.iterations=10", "registration.iterations=6", "final.iterations=30",
)  # fmt: skip
CUTS = ("submaps.frames=5", "loops.min_interval=1", "loops.near_m=2")
"""Settings of presets that cut submaps."""


def words(text: str, *settings: str) -> str:
    """Return words of a command line with more settings."""
    return " ".join([text, *(f"--set {setting}" for setting in settings)])


def few(preset: str, *settings: str) -> str:
    """Return the words of a short run of a preset on redkitchen."""
    return words(f"redkitchen --preset {preset} --limit 16 --no-eval", *FEW, *settings)


ROOM = "synthetic:width=160,height=120,noise=1"
SCORED = ("input.width=160", *PLAIN)
"""Scores and their pictures take longer than the run itself: runs with scores have small images."""
CASES = {
    "redkitchen-sigma": words("redkitchen --limit 60 --hold-out 8 --no-eval", "final.iterations=60"),
    "livingroom-sigma": words("livingroom --limit 40 --no-eval", *PLAIN),
    "hololens-sigma": words("hololens --limit 40 --no-eval", *PLAIN),
    "cubicles-sigma": words("cubicles --limit 50 --no-eval", *PLAIN),
    "fr1_xyz-sigma": words("fr1_xyz --limit 40 --no-eval", *PLAIN),
    "cabinet58-sigma": words("cabinet58 --limit 40 --no-eval", *PLAIN),
    "wide-sigma": words("fr1_xyz --stride 15 --hold-out 10", *SCORED),
    "raw-sigma": words("redkitchen_raw --limit 10 --no-eval", *PLAIN),
    "stereo-sigma": words("street --limit 5 --no-eval", *PLAIN),
    "loops-sigma": words("redkitchen --limit 30 --no-eval", "input.width=160", *CUTS, "final.iterations=20"),
    "room-sigma": words(f"{ROOM},frames=40,rooms=2,drift=6 --no-eval", *PLAIN),
    "ball-sigma": words(f"{ROOM},frames=40,mover=20 --seed 1 --no-eval", *PLAIN),
    "predicted-sigma": words(f"{ROOM},frames=20,predicted=1 --no-eval", *PLAIN),
    "varsplat-fast": words("redkitchen --preset varsplat-fast --limit 25 --hold-out 10", *FEW, *CUTS),
    "cgslam-fast": few("cgslam-fast"),
    "loopsplat-fast": few("loopsplat-fast", *CUTS),
    "cgslam-loops-fast": few("cgslam-loops-fast", *CUTS),
    "varsplat-tum": few("varsplat-tum", *CUTS),
    "varsplat-replica": few("varsplat-replica", *CUTS),
    "varsplat-scannetpp": few("varsplat-scannetpp", *CUTS),
    "loopsplat-tum": few("loopsplat-tum", *CUTS),
    "cgslam-tum": few("cgslam-tum", "mapping.every=5"),
    "cgslam-replica": few("cgslam-replica", "mapping.every=5"),
    "cgslam-light-tum": few("cgslam-light-tum", "mapping.every=5"),
    "cgslam-loops-tum": few("cgslam-loops-tum", "mapping.every=3", *CUTS),
    "varsplat-released-fr1-desk": few("varsplat-released-fr1-desk", *CUTS),
    "varsplat-released-room0": few("varsplat-released-room0", *CUTS),
    "varsplat-released-scene0000": few("varsplat-released-scene0000", *CUTS),
    "cgslam-released-fr1-desk": few("cgslam-released-fr1-desk", "mapping.every=5"),
    "cgslam-released-replica": few("cgslam-released-replica", "mapping.every=5"),
}
"""Words of the command line after `sigmasplat run`, as this checkout has them, by the name of the run."""
SPELLED_BEFORE: dict[str, str] = {}
"""Text in these words → text for the other commit, such as "--preset a" → "--preset b" or "loops.near=" →
"loops.near_m=". A commit that refuses the result (exit code 2) gets the words as they are."""
RENAMED: dict[str, str] = {}
"""Files and keys of results that were renamed, old → new; a key may have dots, such as "tracking.doubtful". The new
name "" leaves it out."""
