"""File names that hold times, and recordings of phone apps: times, pairs, intrinsics per frame, shapes."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import layouts
import recordings
from layouts import FRAMES, SMALL_CAMERA, sample
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import ASSUMED, GIVEN
from sigmasplat.plugins.sources import open_source

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
READ = "read from the names"


def case(name: str) -> Path:
    if not (CASES / name).is_dir():
        pytest.skip(f"no {CASES / name}")
    return CASES / name / "rec"


def named(folder: Path, colors: list[str], depths: list[str] | None = None) -> Path:
    """Write a plain folder; the corner of frame n is n + 1 deep, m, and the camera is known."""
    for part, names in (("color", colors), ("depth", colors if depths is None else depths)):
        for n, name in enumerate(names):
            image = (
                np.full((24, 32, 3), 90, np.uint8) if part == "color" else np.full((24, 32), 1000 * (n + 1), np.uint16)
            )
            layouts.save(folder / f"{part}/{name}.png", image)
    (folder / "calibration.json").write_text(json.dumps({"fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}))
    return folder


def test_decimal_names_are_times_in_the_order_of_numbers() -> None:
    source = open_source(case("01-float-names"))
    times_s = [source.timestamp_s(i) for i in range(len(source))]
    assert (times_s[0], times_s[-1]) == (1612345678.0, 1612345679.9667) and np.all(np.diff(times_s) > 0.03)
    assert source.origins["times"].origin == READ


def test_streams_with_times_in_ns_pair_by_time() -> None:
    source = open_source(case("02-ns-names-unpaired"))
    assert len(source) == 54 and source.origins["pairs"].origin == READ
    frame = source.frame(0)
    assert frame.timestamp_s == pytest.approx(1612345678.1, abs=1e-6)
    assert frame.depth_late_s == pytest.approx(0.0041, abs=1e-6)


STEP = 1 / 30
TIMES = [n * STEP for n in range(12)]
EPOCH = 1612345678
WRITTEN: dict[str, tuple[Callable[[float], str], float]] = {
    "zeros dropped": (lambda t: f"{round(EPOCH + t, 4)}", EPOCH),
    "before a word": (lambda t: f"{EPOCH + t:.4f}_rgb", EPOCH),
    "after a word": (lambda t: f"frame_{EPOCH + t:.4f}", EPOCH),
    "with an index": (lambda t: f"{round(t * 30):06d}_{EPOCH + t:.6f}", EPOCH),
    "ns": (lambda t: f"{EPOCH * 10**9 + round(t * 1e9)}", EPOCH),
    "µs": (lambda t: f"img{EPOCH * 10**6 + round(t * 1e6)}", EPOCH),
    "ms": (lambda t: f"{EPOCH * 10**3 + round(t * 1e3)}", EPOCH),
    "s and ns": (lambda t: f"{EPOCH}_{round(t * 1e9):09d}", EPOCH),
    "ns since the start of the computer": (lambda t: f"{123_456_789_000 + round(t * 1e9)}", 123.456789),
    "ns after 20 days": (lambda t: f"{1_728_000 * 10**9 + round(t * 1e9)}", 1_728_000.0),
    "µs since the start": (lambda t: f"{round(t * 1e6):012d}", 0.0),
    "ms since the start": (lambda t: f"{round(t * 1e3)}", 0.0),
    "ms with decimals": (lambda t: f"{EPOCH * 1e3 + t * 1e3:.3f}", EPOCH),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRITTEN)
def test_times_in_names_are_read(kind: str, tmp_path: Path) -> None:
    write, start_s = WRITTEN[kind]
    source = open_source(named(tmp_path / "rec", [write(t) for t in TIMES]))
    found = [source.timestamp_s(i) for i in range(len(source))]
    assert found == pytest.approx([start_s + t for t in TIMES], abs=6e-4)
    assert [source.frame(i).depth_m[0, 0] for i in (0, 5, 11)] == [1, 6, 12]
    assert source.origins["times"].origin == READ


def test_whole_seconds_may_lack_their_point(tmp_path: Path) -> None:
    source = open_source(named(tmp_path / "rec", ["9.5", "10", "10.25", "11"]))
    assert [source.timestamp_s(i) for i in range(4)] == [9.5, 10.0, 10.25, 11.0]


@pytest.mark.parametrize(
    "names",
    [
        [f"{n:06d}" for n in range(12)],
        [f"frame{n}" for n in range(12)],
        [f"{10 * n:06d}" for n in range(12)],
        [f"{40 * n}" for n in range(12) if n != 5],
        [f"cam1.{n:04d}" for n in range(12)],
        [f"IMG_{n}" for n in (12, 60, 71, 300, 420, 425, 800)],
        ["a", "b", "c"],
    ],
    ids=["zeros", "frame0", "every tenth", "every 40th, one lost", "a number after a point", "photos", "letters"],
)
def test_ordinary_names_are_no_times(names: list[str], tmp_path: Path) -> None:
    source = open_source(named(tmp_path / "rec", names))
    assert [source.timestamp_s(i) for i in range(len(source))] == [i / 30 for i in range(len(names))]
    assert source.origins["times"].origin == ASSUMED and any("1/30 s apart" in line for line in source.assumptions)
    assert [frame.depth_m[0, 0] for frame in source] == [n + 1 for n in range(len(names))]
    assert source.origins["pairs"].origin == READ


def test_different_units_and_a_lost_frame_pair_by_time(tmp_path: Path) -> None:
    colors = [f"{EPOCH + t:.6f}" for t in TIMES]
    depths = [f"depth_{EPOCH * 10**9 + round((t + 0.005) * 1e9)}" for t in TIMES[2:]]
    source = open_source(named(tmp_path / "rec", colors, depths))
    assert len(source) == 10 and source.frame(0).depth_m[0, 0] == 1.0 and len(source.skipped) == 2
    assert source.frame(0).depth_late_s == pytest.approx(0.005, abs=1e-5)


@pytest.mark.parametrize(
    ("colors", "depths"),
    [
        ([f"{100 + n}" for n in range(8)], [f"{500 + n}" for n in range(8)]),
        (list("abcdefgh"), [f"depth{n}" for n in range(8)]),
        (list("abcdefgh"), [f"x_{c}" for c in "abcdefgh"]),
    ],
    ids=["two counts", "letters and a count", "letters"],
)
def test_names_that_only_count_pair_by_order_and_say_so(colors: list[str], depths: list[str], tmp_path: Path) -> None:
    source = open_source(named(tmp_path / "rec", colors, depths))
    assert len(source) == 8 and source.origins["pairs"].origin == ASSUMED
    assert any("by order (write rgb.txt and depth.txt" in line for line in source.assumptions)


REFUSED = {
    "only colour has times": ([f"{EPOCH + t:.4f}" for t in TIMES], [f"{n:04d}" for n in range(12)]),
    "one file fewer": ([f"{n}" for n in range(12)], [f"{100 + n}" for n in range(11)]),
    "numbers that do not count": (list("abcde"), ["3", "9", "10", "40", "41"]),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_the_remedies_for_names_that_do_not_pair(kind: str, tmp_path: Path) -> None:
    colors, depths = REFUSED[kind]
    folder = named(tmp_path / "rec", colors, depths)
    with pytest.raises(SourceError, match=r"in common .*; write rgb\.txt and depth\.txt with"):
        open_source(folder)
    for part, names in (("color", colors), ("depth", depths)):
        lines = "".join(f"{n / 30:.4f} {part}/{name}.png\n" for n, name in enumerate(names))
        (folder / {"color": "rgb.txt", "depth": "depth.txt"}[part]).write_text(lines)
    assert len(open_source(folder)) == len(depths)
    for part in ("rgb.txt", "depth.txt"):
        (folder / part).unlink()
    for color, depth in zip(colors, depths, strict=False):
        (folder / f"depth/{depth}.png").rename(folder / f"depth/{color}.png")
    assert len(open_source(folder)) == len(depths)


def test_redwood_says_how_late_depth_is_and_whose_camera_it_takes(tmp_path: Path) -> None:
    source = open_source(layouts.redwood(tmp_path, sample((640, 480))))
    assert source.frame(0).depth_late_s == pytest.approx(0.005)
    assert source.origins["camera"].origin == ASSUMED and source.origins["times"].origin == READ


@pytest.mark.parametrize("write", [lambda t: f"{EPOCH + t:.4f}", lambda t: f"{EPOCH * 10**9 + round(t * 1e9)}"])
def test_times_in_names_beside_open3ds_intrinsics(write: Callable[[float], str], tmp_path: Path) -> None:
    folder = named(tmp_path / "rec", [write(t) for t in TIMES], [write(t + 0.004) for t in TIMES[3:]])
    camera = {"width": 32, "height": 24, "intrinsic_matrix": [30.0, 0, 0, 0, 30.0, 0, 15.5, 11.5, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(camera))
    source = open_source(folder)
    assert len(source) == 9 and source.timestamp_s(0) == pytest.approx(EPOCH + 0.1, abs=1e-3)
    assert source.frame(0).depth_m[0, 0] == 1.0 and source.origins["pairs"].origin == READ


# transforms.json


def changed(folder: Path, change: Callable[[dict], object]) -> Path:
    path = folder / "transforms.json"
    fields = json.loads(path.read_text())
    change(fields)
    path.write_text(json.dumps(fields))
    return folder


def per_frame(*factors: float) -> Callable[[dict], object]:
    """Give each frame its own focal length, the camera's times a factor."""

    def change(fields: dict) -> None:
        for frame, factor in zip(fields["frames"], factors, strict=True):
            frame.update(fl_x=fields["fl_x"] * factor, fl_y=fields["fl_y"] * factor)

    return change


def test_the_keys_of_nerfcapture_are_read() -> None:
    source = open_source(case("05-nerfcapture"))
    assert (len(source), source.depth_units_per_metre, source.timestamp_s(1)) == (30, 6553.5, 0.06666666666666667)
    assert source.origins["depth unit"].origin.endswith("transforms.json")
    assert "timestamp" in source.origins["times"].value


def test_without_depth_the_keys_of_a_frame_are_named(tmp_path: Path) -> None:
    folder = changed(
        layouts.nerfstudio(tmp_path, sample()),
        lambda fields: [frame.update(depth_map=frame.pop("depth_file_path")) for frame in fields["frames"]],
    )
    next(folder.glob("depth*")).rename(folder / "maps")
    with pytest.raises(SourceError, match=r"file_path, transform_matrix, depth_map\); export depth"):
        open_source(folder)


def test_a_depth_scale_beside_the_file_and_none_in_it(tmp_path: Path) -> None:
    folder = layouts.nerfstudio(tmp_path, sample())
    assert open_source(folder).origins["depth unit"].origin == ASSUMED
    (folder / "calibration.json").write_text('{"depth_scale": 6553.5}')
    source = open_source(folder)
    assert (source.depth_units_per_metre, source.camera) == (6553.5, SMALL_CAMERA)


def test_timestamps_order_the_frames_unless_they_count(tmp_path: Path) -> None:
    folder = layouts.nerfstudio(tmp_path, sample())

    def stamped(scale: int) -> Callable[[dict], object]:
        return lambda f: [
            frame.update(timestamp=scale * (20 - int(frame["file_path"][13:-4]))) for frame in f["frames"]
        ]

    in_order = [frame.depth_m[-1, -1] for frame in open_source(folder)]
    assert [frame.depth_m[-1, -1] for frame in open_source(changed(folder, stamped(1)))] == in_order
    source = open_source(changed(folder, stamped(33_333_333)))
    assert [frame.depth_m[-1, -1] for frame in source] == in_order[::-1]
    assert source.timestamp_s(1) - source.timestamp_s(0) == pytest.approx(1 / 30)
    assert source.truth().T_world_camera[0, :3, 3] == pytest.approx(sample().T_world_camera[3, :3, 3])


def test_autofocus_takes_the_median_and_says_so() -> None:
    source = open_source(case("06-intrinsics-per-frame"))
    assert source.camera.fx == pytest.approx(130.0, abs=0.1)
    assert source.origins["camera"].origin == "measured, median of 30 frames, they differ by 0.6 %"
    given = open_source(case("06-intrinsics-per-frame"), fx=130.0, fy=130.0, cx=79.6, cy=59.6)
    assert given.origins["camera"].origin == GIVEN and given.camera.cx == 79.6


def test_cameras_that_differ_more_are_resampled_to_one(tmp_path: Path) -> None:
    folder = layouts.nerfstudio(tmp_path, sample())
    one = open_source(folder).frame(1)
    source = open_source(changed(folder, per_frame(1.1, 1.0, 1.0, 0.9)))
    assert source.camera == SMALL_CAMERA and source.origins["camera"].origin.endswith("resampled")
    # Frame 9, the last of the file, has 0.9 of the focal length: its pixels are nearer to the centre.
    c, (x, y) = SMALL_CAMERA, (28, 20)
    u, v = 0.9 * (x - c.cx) + c.cx, 0.9 * (y - c.cy) + c.cy
    frame = source.frame(1)
    assert frame.depth_m[y, x] == one.depth_m[round(v), round(u)] != one.depth_m[y, x]
    low, high = one.color[int(v), int(u)], one.color[int(v) + 1, int(u) + 1]
    assert (low - 0.01 <= frame.color[y, x]).all() and (frame.color[y, x] <= high + 0.01).all()
    assert np.array_equal(source.depth_of(1), frame.depth_m)
    given = open_source(folder, fx=30.0, fy=31.5, cx=15.0, cy=12.0)
    assert np.array_equal(given.frame(1).depth_m, one.depth_m), "one camera is given for all frames"


def test_frames_of_several_sizes_are_refused_until_the_others_are_removed(tmp_path: Path) -> None:
    folder = changed(layouts.nerfstudio(tmp_path, sample()), lambda fields: fields["frames"][0].update(w=64))
    with pytest.raises(SourceError, match=r"several cameras \(w 32 and 64, .*remove the others"):
        open_source(folder)
    assert len(open_source(changed(folder, lambda fields: fields["frames"].pop(0)))) == FRAMES - 1


def test_stray_scanner_and_record3d_say_that_they_take_the_median(tmp_path: Path) -> None:
    pytest.importorskip("lzfse", reason="Record3D needs the extra iphone")
    stray = open_source(recordings.write_stray(tmp_path / "scan", recordings.scene(), per_frame=True))
    assert stray.origins["camera"].origin == "measured, median of 4 frames, they differ by 3.6 %, resampled"
    focal = [[f, f, 16.0, 12.0] for f in (40.0, 40.1, 40.2, 40.1)]
    members = recordings.r3d_members(recordings.scene(), perFrameIntrinsicCoeffs=focal)
    record3d = open_source(recordings.write_zip(tmp_path / "a.r3d", members))
    assert record3d.origins["camera"].origin == "measured, median of 4 frames, they differ by 0.2 %"


# Shapes


def test_portrait_colour_with_landscape_depth_is_refused() -> None:
    with pytest.raises(SourceError, match=r"is 120×160 \(portrait\), depth is 160×120 \(landscape\); rotate"):
        open_source(case("07-portrait-colour-landscape-depth"))


def with_depth(folder: Path, height: int, width: int) -> Path:
    folder = layouts.nerfstudio(folder, sample((96, 72)))
    changed(folder, lambda fields: fields.update(w=96, h=72, cx=48.0, cy=36.0, fl_x=90.0, fl_y=90.0))
    for path in (folder / "depths").iterdir():
        layouts.save(path, np.full((height, width), 2000, np.uint16))
    return folder


def test_rotating_depth_is_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="rotate one of them"):
        open_source(with_depth(tmp_path, 64, 48))
    assert len(open_source(with_depth(tmp_path, 48, 64))) == FRAMES


def test_another_shape_needs_the_depth_camera(tmp_path: Path) -> None:
    folder = with_depth(tmp_path, 36, 64)
    with pytest.raises(SourceError, match=r"is 96×72 .*, depth is 64×36 .*; give depth_camera in"):
        open_source(folder)
    depth_camera = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 17.5, "width": 64, "height": 36}
    (folder / "calibration.json").write_text(json.dumps({"depth_camera": depth_camera}))
    assert open_source(folder).depth_registered


@pytest.mark.parametrize(("height", "width"), [(5, 7), (9, 12), (24, 31)])
def test_rounded_sizes_of_small_depth_are_one_shape(height: int, width: int, tmp_path: Path) -> None:
    assert len(open_source(with_depth(tmp_path, height, width))) == FRAMES
