"""Models of depth noise: what they say, how they reach readings, and what alignment and seeding make of them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from command_line import exit_code
from constants import changed
from paper_settings import InputConfig
from sigmasplat.config.find_preset import preset
from sigmasplat.config.scale import for_scene
from sigmasplat.config.sensors import SENSORS, SensorModel, sensor_model
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.frame_arrays import frame_from_arrays
from sigmasplat.data.images import alignment_std, generic_std, modelled_std
from sigmasplat.data.submap import Picture
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.fit.align import align, balanced
from sigmasplat.fit.references import Reference, confidence_of, live_image, map_reference, picture_images
from sigmasplat.fit.target import Target
from sigmasplat.input.calibration import read_calibration
from sigmasplat.mapping.seeding import make_splats
from sigmasplat.plugins.checks.depth import measure_noise
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.tracking.prepared_frame import view_of, working_frame

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
Floats = NDArray[np.float32]


def wall(tilt: float, z_m: float = 2.0) -> Floats:
    """Return the depth of a wall turned about the vertical axis by `tilt` rad, z_m away at the principal point."""
    u = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    return np.tile((z_m / (1.0 - np.tan(tilt) * u)).astype(np.float32), (CAMERA.height, 1))


def framed(depth_m: Floats, std_m: Floats | None = None) -> Frame:
    color = np.random.default_rng(0).random((*depth_m.shape, 3), np.float32)
    return Frame(0, 0.0, color, depth_m, CAMERA, depth_std_m=std_m)


def test_shipped_models_are_those_of_the_papers() -> None:
    z = np.linspace(0.6, 4.0, 20, dtype=np.float32)[None]
    camera = Camera(20, 1, 20.0, 20.0, 9.5, 0.0)
    plain = {name: modelled_std(z, replace(model, edge=1.0, grazing=0.0), camera) for name, model in SENSORS.items()}
    nguyen, fankhauser = 1.2e-3 + 1.9e-3 * (z - 0.4) ** 2, 1e-3 * (1.5 - 0.5 * z + 0.3 * z * z)
    np.testing.assert_allclose(plain["kinect-v1"], nguyen, rtol=0.12)
    np.testing.assert_allclose(plain["time-of-flight"], fankhauser, rtol=0.35)
    np.testing.assert_allclose(plain["realsense-stereo"][z > 2], (z * z * 0.08 / (424 * 0.05))[z > 2], rtol=0.05)


def test_a_model_is_named_or_spelled_and_everything_else_is_refused() -> None:
    assert sensor_model("auto") is None and sensor_model("generic") is None
    spelled = sensor_model("base:0.001, z2:0.0015")
    assert spelled == SensorModel(base=0.001, z2=0.0015) and sensor_model(str(spelled)) == spelled
    for wrong in ("kinect", "z3:1", "z2", "z2:x", "z2:-1", "z2:nan", "edge:2", ""):
        with pytest.raises(ConfigError, match=r"input\.sensor"):
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


def test_readings_at_edges_and_angles_are_less_sure() -> None:
    depth_m = wall(0.0)
    depth_m[:, 80:] = 3.0
    depth_m[:5] = 0.0
    std_m = modelled_std(depth_m, SensorModel(z2=0.002, edge=3.0, grazing=1.0), CAMERA)
    assert not std_m[:5].any() and np.isfinite(std_m).all()
    assert std_m[60, 79] == pytest.approx(3 * 0.008) and std_m[60, 80] == pytest.approx(3 * 0.018)
    ray = np.sqrt(1 + (20 - CAMERA.cx) ** 2 / CAMERA.fx**2)
    assert std_m[60, 20] == pytest.approx(0.008 * ray, rel=0.01), "a ray that is not normal to the wall"
    tilted = modelled_std(wall(1.0), SensorModel(base=0.001, grazing=1.0), CAMERA)
    assert tilted[60, 80] == pytest.approx(0.001 / np.cos(1.0), rel=0.02)


def test_a_frame_refuses_a_reading_without_a_standard_deviation() -> None:
    depth_m = wall(0.2)
    for value in (0.0, np.nan, np.inf, -1.0):
        std_m = np.full_like(depth_m, 0.01)
        std_m[3, 4] = value
        with pytest.raises(SourceError, match="1 depth readings"):
            framed(depth_m, std_m)
        assert framed(np.where(std_m == 0.01, depth_m, np.float32(0)), std_m).depth_std_m is not None
    with pytest.raises(SourceError, match="float32"):
        framed(depth_m, np.ones((2, 2), np.float32))


def test_standard_deviations_are_resized_with_their_readings() -> None:
    rng = np.random.default_rng(1)
    depth_m = wall(0.3) * (rng.random((120, 160)) < 0.5)
    std_m = generic_std(depth_m.astype(np.float32), 0.003)
    small = framed(depth_m.astype(np.float32), std_m).prepared(80, 0.5, 2.2, crop_px=4)
    assert small.depth_std_m is not None and small.depth_std_m.shape == small.depth_m.shape
    np.testing.assert_array_equal(small.depth_std_m > 0, small.depth_m > 0)
    np.testing.assert_allclose(small.depth_std_m, 0.003 * small.depth_m**2, rtol=0.05)
    seen = framed(depth_m.astype(np.float32), std_m).seen_by(Camera(80, 60, 60.0, 60.0, 39.5, 29.5))
    assert seen.depth_std_m is not None and ((seen.depth_std_m > 0) == (seen.depth_m > 0)).all()
    given = frame_from_arrays(
        np.zeros((120, 160, 3), np.uint8), np.full((120, 160), 2000, np.uint16), CAMERA, 0.0, depth_scale=1000,
        depth_std=np.full((120, 160), 5, np.uint16),
    )  # fmt: skip
    assert given.depth_std_m is not None and given.depth_std_m[0, 0] == np.float32(0.005)


def test_a_model_equal_to_the_law_gives_the_same_bits() -> None:
    config = preset("sigma").changed(input={"width": 160}, tracking={"verify": True})
    found = []
    for name in ("z2:0.003", "auto", "base:0.02,z2:0.001"):
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


def test_every_alignment_uses_the_model() -> None:
    """A stored keyframe, a rendered map, and a reference without a part of it align like the live image."""
    noise = {}
    for name in ("auto", "base:0.02,shared:0.003"):
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
    for relative, depth_m in zip(noise["base:0.02,shared:0.003"], depths, strict=True):
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
    np.testing.assert_array_equal(modelled_std(depth_m, alone, CAMERA), modelled_std(depth_m, shared, CAMERA))
    np.testing.assert_allclose(alignment_std(depth_m, shared), np.hypot(0.001, 0.002) * depth_m**2, rtol=1e-6)
    assert sensor_model(str(shared)) == shared


def test_the_noise_of_a_recording_is_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    frames = []
    for i in range(8):
        depth_m = wall(0.9 if i % 2 else -0.9, 1.2 + 0.3 * i)
        depth_m[40:60] *= np.float32(0.8)  # steps
        noisy = depth_m + rng.standard_normal(depth_m.shape) * np.sqrt(0.003**2 + (0.002 * depth_m**2) ** 2)
        noisy[:, :9] = 0.0
        frames.append(framed(np.clip(noisy, 0, None).astype(np.float32)))
    found = measure_noise(frames)
    assert found is not None
    assert found.model.base == pytest.approx(0.003, rel=0.15) and found.model.z2 == pytest.approx(0.002, rel=0.15)
    assert measure_noise(frames[:0]) is None and measure_noise([framed(np.zeros((120, 160), np.float32))]) is None
    report = tmp_path / "found.json"
    room = "synthetic:frames=4,width=96,height=72,noise=1"
    assert exit_code("inspect", room, "--json", str(report), "--out", str(tmp_path / "sheet.png")) in (0, 1)
    noise = json.loads(report.read_text())["depth_noise"]
    assert noise["in_use"]["std_m"][1] == pytest.approx(0.012) and sensor_model(noise["model"]) is not None
