"""Each handed case ends as its case.md asks; the kinds are tested beside it, with inputs that are made there."""

from pathlib import Path

import numpy as np
import pytest

from sigmasplat.errors import SourceError
from sigmasplat.input.opening import open_source

CASES = Path(__file__).parents[3] / "shared" / "cases"
if not CASES.is_dir():
    pytest.skip(f"the handed cases are not in {CASES}", allow_module_level=True)

READ = {
    "01-float-names/rec": (60, "times", "1612345678.000 … 1612345679.967 s"),
    "02-ns-names-unpaired/rec": (54, "pairs", "by time, within 0.02 s"),
    "05-nerfcapture/rec": (30, "depth unit", "6553.5 per metre"),
    "06-intrinsics-per-frame/rec": (30, "camera", "fx 130"),
    "08-exif-180/rec": (60, "orientation", "turned by the EXIF tag of the images (180°)"),
    "10-infrared-16bit/rec": (30, "gray", "value 4096 becomes white"),
    "18-gray-camera-bag/rec": (15, "pairs", "within 0.02 s"),
    "18-gray-camera-bag/yuyv": (5, "pairs", "within 0.02 s"),
    "21-depth-in-other-files/exr": (10, "depth unit", "metres, as usual for floats"),
    "21-depth-in-other-files/npz": (10, "depth unit", "metres, as usual for floats"),
    "22-lists-from-windows/rec": (20, "depth unit", "1000 per metre"),
}
REFUSED = {
    "07-portrait-colour-landscape-depth/rec": "colour is 120×160 (portrait), depth is 160×120 (landscape); rotate one",
    "11-sqlite-of-another-program/map.db": "is a database of RTAB-Map; export its images with: rtabmap-export --images",
    "19-depth-30-ms-late-bag/rec": "depth is stamped 0.030 s late: --set input.depth_delay_s=0.030",
    "21-depth-in-other-files/jpg": "found 10 other files, such as 0000.jpg); export 16-bit PNG, or float metres",
}


@pytest.mark.parametrize("place", READ)
def test_it_is_read_and_says_how(place: str) -> None:
    frames, name, words = READ[place]
    source = open_source(CASES / place)
    assert len(source) == frames and words in source.origins[name].value
    depth_m = source.frame(frames // 2).depth_m
    assert np.median(depth_m[depth_m > 0]) == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize("place", REFUSED)
def test_it_is_refused_with_what_was_found_and_what_to_do(place: str) -> None:
    with pytest.raises(SourceError) as refused:
        open_source(CASES / place)
    assert REFUSED[place] in str(refused.value) and "\n" not in str(refused.value)


def test_what_the_refusal_of_late_depth_prints_works() -> None:
    source = open_source(CASES / "19-depth-30-ms-late-bag/rec", depth_delay_s=0.03)
    assert len(source) == 30 and abs(source.frame(3).depth_late_s) < 0.005


def test_float_millimetres_are_divided_if_the_option_is_given() -> None:
    depth_m = open_source(CASES / "09-float-millimetres/rec", depth_scale=1000.0).frame(0).depth_m
    assert np.median(depth_m[depth_m > 0]) == pytest.approx(3.0, abs=0.5)


def test_poses_with_an_id_are_read_and_their_convention_is_said() -> None:
    folder = CASES / "20-poses-with-an-id"
    source = open_source(folder / "rec", poses=str(folder / "poses_id.txt"))
    assert source.frame(0).T_given_camera is not None
    assert any(line.startswith("poses: camera to world") for line in source.assumptions)
