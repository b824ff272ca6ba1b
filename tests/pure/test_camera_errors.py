"""What is wrong with a stated camera: measured from pairs of images, written to a file, and corrected in a source."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from late_images import CAMERA, frame
from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera_errors import KNOWN_NONE, CameraErrors, corner_share, sensor_said
from sigmasplat.data.frame import Frame
from sigmasplat.data.readout import AT_ONCE, UNKNOWN_TIMES, SensorTimes
from sigmasplat.errors import ConfigError
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import gray_of
from sigmasplat.graph.sensor_fit import BIAS, Pair
from sigmasplat.plugins.sources import open_source
from sigmasplat.run.calibrate import CAMERA as PARAMETERS, camera_errors

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

STD = (0.001, 0.002, 0.003, 0.004, 0.005)
ERRORS = CameraErrors(0.02, -0.0125, 0.0125, 0.01, 0.4, std=STD)
NUMBERS = "0.01,0,0.03,0.001,0.002,0.003,0.02,-0.0125,0.0125,0.01,0.4,0.001,0.002,0.003,0.004,0.005"


def stated(true: Frame, errors: CameraErrors) -> Frame:
    """Return a frame of the true camera as a camera with these errors states it."""
    c = true.camera
    v, u = np.mgrid[: c.height, : c.width].astype(np.float32)
    darker = 1.0 - errors.falloff * corner_share(u, v, c)
    camera = replace(
        c, fx=c.fx / (1 + errors.focal), fy=c.fy / (1 + errors.focal), cx=c.cx - errors.center_x * c.width,
        cy=c.cy - errors.center_y * c.width,
    )  # fmt: skip
    depth_m = 1.0 / (1.0 / true.depth_m - errors.inverse_depth)
    color = true.color * darker[..., None]
    return replace(true, camera=camera, color=color.astype(np.float32), depth_m=depth_m.astype(np.float32))


def pairs(errors: CameraErrors, count: int = 40) -> list[Pair]:
    """Return noisy images in pairs, from poses that differ every time."""
    random, found = np.random.default_rng(1), []
    for k in range(count):
        poses = [se3.exp(random.normal(0.0, 0.05, 6)) for _ in range(2)]
        seen = [stated(frame(T, seed=100 * k + i), errors) for i, T in enumerate(poses)]
        images = [Pyramid.of(gray_of(s.color), s.depth_m, s.camera).half() for s in seen]
        found.append(Pair(images[0], images[1], AT_ONCE, AT_ONCE, se3.inverse(poses[1]) @ poses[0], k))
    return found


def test_the_errors_of_a_camera_are_measured() -> None:
    found = camera_errors(pairs(ERRORS), UNKNOWN_TIMES)
    assert found.std is not None
    off, limits = np.abs(np.subtract(found.values, ERRORS.values)), (0.003, 0.004, 0.004, 0.002, 0.02)
    assert (off < limits).all(), found
    shown = np.sqrt(np.array(found.std[:4]) ** 2 - (BIAS * PARAMETERS.units) ** 2)  # without the systematic error
    assert (off[:4] < 4.0 * shown).all(), found


def test_of_a_camera_without_errors_nothing_is_found() -> None:
    found = camera_errors(pairs(KNOWN_NONE), UNKNOWN_TIMES)
    assert not any(found.values) and found.std is not None and max(found.std[:4]) < 0.002
    assert camera_errors(pairs(KNOWN_NONE, 5), UNKNOWN_TIMES) is KNOWN_NONE


def test_a_frame_is_corrected() -> None:
    true = frame(np.eye(4))
    found = ERRORS.frame(stated(true, ERRORS))
    assert np.allclose(found.color, true.color, atol=1e-5) and np.allclose(found.depth_m, true.depth_m, rtol=1e-5)
    assert np.allclose([found.camera.fx, found.camera.cx], [CAMERA.fx, CAMERA.cx])
    holes = replace(true, depth_m=np.where(true.depth_m > 1.5, true.depth_m, np.float32(0.0)))
    assert np.array_equal(ERRORS.frame(holes).depth_m > 0, holes.depth_m > 0)
    black = CameraErrors(falloff=1.0).frame(replace(true, color=np.zeros_like(true.color)))
    assert np.array_equal(black.color, np.zeros_like(true.color)), "corners without any light stay black"


def test_a_source_has_no_errors_once_they_are_known() -> None:
    """The faults of a synthetic room, as a file for `input.calibrate` corrects them."""
    true = open_source("synthetic:frames=3,width=96,height=72,exposure_change=0")
    wrong = "synthetic:frames=3,width=96,height=72,exposure_change=0,focal=0.02,center_x=3,center_y=-2,falloff=0.4"
    known = f"0,0,0,0,0,0,{1 / 1.02 - 1},{-3 / 96},{2 / 96},0,0.4,0,0,0,0,0"
    found = open_source(wrong, calibrate=known)
    assert len(found) == 3 and found.timestamp_s(2) == true.timestamp_s(2)
    for camera in (found.camera, found.frame(1).camera):
        assert np.allclose(
            [camera.fx, camera.cx, camera.cy], [true.camera.fx, true.camera.cx, true.camera.cy], rtol=1e-5
        )
    assert np.array_equal(found.frame(1).depth_m, true.frame(1).depth_m)
    assert np.abs(found.frame(1).color - true.frame(1).color).max() < 0.006, "rounded to bytes when it was darker"
    assert np.abs(open_source(wrong).frame(1).color - true.frame(1).color).max() > 0.2


def test_a_file_becomes_sixteen_numbers_and_a_run_notes_them(tmp_path: Path) -> None:
    times = SensorTimes(0.01, 0.0, 0.03, std_s=(0.001, 0.002, 0.003))
    facts = {"source": "x"} | times.noted() | ERRORS.noted()
    (tmp_path / "a.json").write_text(json.dumps(facts))
    settings = InputConfig(calibrate=str(tmp_path / "a.json"))
    assert settings.calibrate == NUMBERS == InputConfig(calibrate=NUMBERS).calibrate
    assert CameraErrors.given(NUMBERS) == CameraErrors.noted_in(json.loads(json.dumps(facts))) == ERRORS
    assert SensorTimes.given(NUMBERS) == times
    assert CameraErrors.given("auto") is CameraErrors.given("0,0,0,0,0,0") is CameraErrors.noted_in({}) is KNOWN_NONE
    said = sensor_said(facts)
    assert times.said() in said and "focal length 2.00 ± 0.10 %" in said and "darker corners 40.00 ± 0.50 %" in said


@pytest.mark.parametrize(
    ("change", "message"),
    [({"focal": "long"}, "focal must be a number, found 'long'"), ({"std": [0.1]}, "std must be a number, found None"),
     ({"falloff": 7}, "falloff must be between -1 and 1, found 7")],
)  # fmt: skip
def test_bad_errors_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    facts = SensorTimes(std_s=(0.001, 0.001, 0.001)).noted() | ERRORS.noted()
    facts["camera_errors"] |= change
    (tmp_path / "a.json").write_text(json.dumps(facts))
    with pytest.raises(ConfigError) as refused:
        InputConfig(calibrate=str(tmp_path / "a.json"))
    assert message in str(refused.value) and "\n" not in str(refused.value)
