"""Models of depth noise: what they say, how they reach readings, and what alignment and seeding make of them."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from constants import changed
from paper_settings import InputConfig
from sigmasplat.config import SECTIONS
from sigmasplat.config.find_preset import preset
from sigmasplat.config.input import RENDERED, SENSORS, SensorModel, sensor_model
from sigmasplat.config.ranges import kinds_of
from sigmasplat.config.scale import for_scene
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.images import alignment_std, distance_std
from sigmasplat.data.submap import Picture
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.fit.align import align, balanced
from sigmasplat.fit.references import Reference, confidence_of, live_image, map_reference, picture_images
from sigmasplat.fit.target import Target
from sigmasplat.input.calibration import read_calibration
from sigmasplat.mapping.seeding import make_splats
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.tracking.prepared_frame import view_of, working_frame

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
Floats = NDArray[np.float32]


def wall(tilt: float, z_m: float = 2.0) -> Floats:
    """Return the depth of a wall turned about the vertical axis by `tilt` rad, z_m away at the principal point."""
    u = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    return np.tile((z_m / (1.0 - np.tan(tilt) * u)).astype(np.float32), (CAMERA.height, 1))


def framed(depth_m: Floats) -> Frame:
    color = np.random.default_rng(0).random((*depth_m.shape, 3), np.float32)
    return Frame(0, 0.0, color, depth_m, CAMERA)


def test_shipped_models_are_those_of_the_papers() -> None:
    z = np.linspace(0.6, 4.0, 20, dtype=np.float32)[None]
    plain = {name: distance_std(z, model) for name, model in SENSORS.items()}
    nguyen, fankhauser = 1.2e-3 + 1.9e-3 * (z - 0.4) ** 2, 1e-3 * (1.5 - 0.5 * z + 0.3 * z * z)
    np.testing.assert_allclose(plain["kinect-v1"], nguyen, rtol=0.12)
    np.testing.assert_allclose(plain["time-of-flight"], fankhauser, rtol=0.35)
    np.testing.assert_allclose(plain["realsense-stereo"][z > 2], (z * z * 0.08 / (424 * 0.05))[z > 2], rtol=0.05)


def test_a_sensor_is_named_and_everything_else_is_refused() -> None:
    assert sensor_model("auto") is None and sensor_model("generic") is None
    assert get_args(kinds_of(SECTIONS["input"])["sensor"]) == ("auto", "generic", *SENSORS, RENDERED)
    for wrong in ("kinect", "z2:0.001", ""):
        with pytest.raises(ConfigError, match=r"input\.sensor must be one of auto, generic, kinect-v1"):
            InputConfig(sensor=wrong)
    assert for_scene(BASE, 1.0, None, sensor="kinect-v1").input.sensor == "kinect-v1"
    assert for_scene(BASE.changed(input={"sensor": "generic"}), 1.0, None, sensor="kinect-v1").input.sensor == "generic"


def test_a_calibration_names_its_sensor(tmp_path: Path) -> None:
    file, fields = tmp_path / "calibration.json", {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    file.write_text(json.dumps(fields | {"sensor": "lidar-iphone"}))
    assert read_calibration(file, (640, 480), 1000.0).sensor == "lidar-iphone"
    file.write_text(json.dumps(fields | {"sensor": "sonar"}))
    with pytest.raises(SourceError, match="sonar"):
        read_calibration(file, (640, 480), 1000.0)


def test_a_model_equal_to_the_law_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SENSORS, "kinect-v1", SensorModel(z2=0.003))
    monkeypatch.setitem(SENSORS, "lidar-iphone", SensorModel(base=0.02, z2=0.001))
    config = preset("sigma").changed(input={"width": 160}, tracking={"verify": True})
    found = []
    for name in ("kinect-v1", "auto", "lidar-iphone"):
        settings = config.changed(input={"sensor": name})
        frames = [working_frame(framed(wall(tilt)), settings) for tilt in (0.3, 0.31)]
        view = view_of(frames[0].camera, settings)
        targets = [Target.of(frame, (view.sums.shape[1], view.sums.shape[2])) for frame in frames]
        images = [
            live_image(view, frame.color, frame.depth_m, target) for frame, target in zip(frames, targets, strict=True)
        ]
        found.append(align(*images, np.eye(4)).T_live_reference)
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[2] != found[1]).any()


def test_every_alignment_uses_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stored keyframe, a rendered map, and a reference without a part of it align like the live image."""
    monkeypatch.setitem(SENSORS, "kinect-v1", SensorModel(base=0.02, shared=0.003))
    noise = {}
    for name in ("auto", "kinect-v1"):
        settings = preset("sigma").changed(input={"sensor": name, "width": 160}, tracking={"uncertainty": False})
        frame = working_frame(framed(wall(0.3)), settings)
        view = view_of(frame.camera, settings)
        target, stored = picture_images(view, Picture((255 * frame.color).astype(np.uint8), frame.depth_m), CAMERA)
        solid = changed(settings.seeding, opacity=0.99)
        field = make_splats(target, np.eye(4), frame.depth_m > 0, 1.0, GaussianField.empty(), solid)
        rendered = map_reference(field.params, view, np.eye(4), settings.tracking)
        part = Reference(stored, np.eye(4)).without(np.indices((120, 160))[1] < 40)
        noise[name] = [pyramid.noise[0] for pyramid in (stored, rendered.pyramid, part.pyramid)]
        depths = [np.asarray(pyramid.depth[0]) for pyramid in (stored, rendered.pyramid, part.pyramid)]
    assert noise["auto"] == [None, None, None]
    for relative, depth_m in zip(noise["kinect-v1"], depths, strict=True):
        read = depth_m > 0
        assert relative is not None and read.mean() > 0.5
        expected = np.hypot(0.02, 0.003 * depth_m[read] ** 2) / (0.003 * depth_m[read] ** 2)
        np.testing.assert_allclose(np.asarray(relative)[read], expected, rtol=1e-5)


def test_gray_counts_more_where_depth_is_sure() -> None:
    assert confidence_of(SensorModel(z2=0.003)) == 1.0 and confidence_of(SensorModel(z2=0.001)) == pytest.approx(3.0)
    assert (
        confidence_of(SENSORS["kinect-v1"]) == pytest.approx(1.0, abs=0.05)
        and confidence_of(SENSORS["time-of-flight"]) > 5
    )
    assert balanced(0.1, 1.0) == 0.1 and balanced(0.1, 4.0) == pytest.approx(2 / 11), "odds 1:9 become 2:9"
    assert balanced(0.1, 1e6) == 0.5 and balanced(0.8, 4.0) == pytest.approx(0.8), "at most as much as depth"
    assert balanced(0.1, 0.25) == pytest.approx(1 / 19) and balanced(0.0, 4.0) == 0.0 and balanced(1.0, 4.0) == 1.0


def test_errors_that_readings_share_count_in_alignment_only() -> None:
    depth_m, alone, shared = wall(0.0), SensorModel(z2=0.001), SensorModel(z2=0.001, shared=0.002)
    np.testing.assert_array_equal(distance_std(depth_m, alone), distance_std(depth_m, shared))
    np.testing.assert_allclose(alignment_std(depth_m, shared), np.hypot(0.001, 0.002) * depth_m**2, rtol=1e-6)
