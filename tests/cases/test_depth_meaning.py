"""What depth values mean is measured: along the axis or the ray, inverse, a largest value for no reading; and a run
looks at its first frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from recorded_room import OPTIONS, write_images
from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import ASSUMED, GIVEN, MEASURED, unlikely_camera
from sigmasplat.plugins.checks.recording import first_look
from sigmasplat.plugins.sources import open_source
from small_room import frame_at

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
SEEN = [frame_at(i) for i in range(0, 200, 28)]
GIVEN_CAMERA = {"fx": 128.0, "cx": 79.5, "cy": 59.5, "depth_scale": 1000.0}


def recording(folder, change, **settings):
    """Open a recording of the room whose depth is changed, from frame and depth [H, W] in metres."""
    write_images(folder, [replace(frame, depth_m=change(frame, frame.depth_m).astype(np.float32)) for frame in SEEN])
    return open_source(folder, **(GIVEN_CAMERA | settings))


def along_ray(frame, z):
    return z * np.linalg.norm(frame.camera.rays(), axis=-1)


def noisy(change):
    noise = np.random.default_rng(0)
    return lambda frame, z: change(frame, z * (1 + 0.004 * z * noise.normal(size=z.shape)))


def off_m(source):
    """Return the median error of depth, m."""
    return float(np.median(np.abs(source.depth_of(3) - SEEN[3].depth_m)))


@pytest.mark.parametrize("sensor", [lambda change: change, noisy])
def test_depth_along_the_ray_is_found_and_converted(tmp_path, sensor):
    source = recording(tmp_path / "rec", sensor(along_ray))
    assert source.origins["depth"][:2] == ("along the ray, converted to z", MEASURED)
    assert off_m(source) < 0.03
    assert np.array_equal(source.frame(3).depth_m, source.depth_of(3))
    stored = open_source(tmp_path / "rec", **GIVEN_CAMERA, depth_along="z")
    assert stored.origins["depth"][:2] == ("along the optical axis", GIVEN)
    assert off_m(stored) > 0.05, "the user is believed"


@pytest.mark.parametrize("sensor", [lambda change: change, noisy])
def test_depth_along_the_axis_stays_as_it_is(tmp_path, sensor):
    source = recording(tmp_path / "rec", sensor(lambda frame, z: z))
    assert source.origins["depth"][:2] == ("along the optical axis", MEASURED)
    assert off_m(source) < 0.03 and not source.depth_doubts and "farthest depth" not in source.origins
    text, warnings = first_look(source)
    assert "depth 0.88 to 3.8" in text and "brightness" in text and warnings == []
    asked = open_source(tmp_path / "rec", **GIVEN_CAMERA, depth_along="ray")
    assert asked.origins["depth"][:2] == ("along the ray, converted to z", GIVEN) and off_m(asked) > 0.05


def test_without_planes_the_meaning_is_assumed_and_the_option_is_named(tmp_path):
    rough = np.random.default_rng(1)
    source = recording(tmp_path / "rec", lambda frame, z: rough.uniform(1, 3, z.shape))
    assert source.origins["depth"] == ("along the optical axis", ASSUMED, "--set input.depth_along=ray")


@pytest.mark.parametrize(
    ("change", "value"),
    [
        (lambda z, holes: np.minimum(z, 3.2), 3.2),
        (lambda z, holes: np.where(holes, 10.0, z), 10.0),
        (lambda z, holes: np.where(holes, 4.095, np.minimum(z, 4.0)), 4.095),
    ],
)
def test_a_largest_value_of_many_readings_is_no_reading(tmp_path, change, value):
    holes = np.zeros((120, 160), bool)
    holes[20:60, 30:40] = holes[::7, ::5] = True
    source = recording(tmp_path / "rec", lambda frame, z: change(z, holes))
    dropped = source.origins["farthest depth"]
    assert dropped.origin == MEASURED and f"{value:.3f} m" in dropped.value
    depths = [source.depth_of(i) for i in range(len(source))]
    assert max(float(depth.max()) for depth in depths) < value
    assert source.origins["depth"].value == "along the optical axis" and not source.depth_doubts
    kept = open_source(tmp_path / "rec", **GIVEN_CAMERA, depth_along="z")
    assert max(float(kept.depth_of(i).max()) for i in range(len(kept))) == pytest.approx(value)


@pytest.mark.parametrize("shift", [0, 4])
def test_a_parallel_wall_at_the_farthest_distance_is_kept(tmp_path, shift):
    def table_before_wall(frame, z):
        depth = np.full(z.shape, 3.0)
        depth[60:] = np.linspace(2.9, 1.2, 60)[:, None]
        x = 30 + shift * (frame.index // 28)
        depth[50:90, x : x + 30] = 1.5
        return depth

    source = recording(tmp_path / "rec", table_before_wall)
    assert "farthest depth" not in source.origins
    assert float(source.depth_of(0).max()) == 3.0
    assert "--set input.max_depth_m=2.997" in source.depth_doubts[0]
    assert open_source(tmp_path / "rec", **GIVEN_CAMERA, depth_along="z").depth_doubts == []


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_inverse_depth_is_named_with_a_remedy_that_works(tmp_path, factor):
    source = recording(tmp_path / "rec", lambda frame, z: factor / np.maximum(z, 0.1) * (z > 0))
    assert "--predicted-inverse" in source.depth_doubts[0] and source.depth_doubts[0] in first_look(source)[1]
    folder = str(tmp_path / "rec/depth")
    mended = open_source(tmp_path / "rec", **GIVEN_CAMERA, predicted_depth=folder, predicted_inverse=True)
    z, true = mended.frame(3).depth_m, SEEN[3].depth_m
    ratio = z[(z > 0) & (true > 0)] / true[(z > 0) & (true > 0)]
    assert np.percentile(ratio, 90) / np.percentile(ratio, 10) < 1.05


def test_eight_bits_hold_no_depth_and_the_refusal_says_what_does(tmp_path):
    write_images(tmp_path / "rec", SEEN[:2])
    for path in (tmp_path / "rec/depth").iterdir():
        Image.fromarray(np.full((120, 160), 80, np.uint8)).save(path)
    with pytest.raises(SourceError, match="8 bits hold no metric depth: export 16-bit PNG"):
        open_source(tmp_path / "rec", **GIVEN_CAMERA)


@pytest.mark.parametrize(("width", "height"), [(120, 160), (160, 120), (1080, 1920)])
def test_the_centre_of_an_image_that_was_turned_is_named(width, height):
    turned = Camera(width, height, 130.0 * width / 120, 130.0 * width / 120, (height - 1) / 2, (width - 1) / 2 - 0.5)
    assert f"fits an image of {height}×{width}, these are {width}×{height}" in unlikely_camera(turned)
    assert unlikely_camera(replace(turned, cx=(width - 1) / 2 + 3, cy=(height - 1) / 2 - 4)) is None


def test_a_run_says_what_it_looked_at_and_warns_before_it_starts(tmp_path, capfd):
    write_images(tmp_path / "rec", [replace(frame, depth_m=np.minimum(frame.depth_m, 3.2)) for frame in SEEN[:4]])
    given = (*OPTIONS[:2], "--cx", "59.5", "--cy", "79.5", *OPTIONS[6:], "--limit", "2", "--no-eval")
    quick = ("--set", "final.iterations=0", "--set", "mapping.iterations=1", "--set", "mapping.first_iterations=2")
    assert exit_code("run", str(tmp_path / "rec"), *given, *quick, "--out", str(tmp_path / "run")) == 0
    said, warned = capfd.readouterr()
    looked = said.index("looked at 2 of the first frames: depth")
    assert said.index("assumed, because") < looked < said.index("SLAM")
    assert "fits an image of 120×160, these are 160×120" in warned


@pytest.mark.skipif(not CASES.is_dir(), reason="no shared cases")
def test_the_handed_case_of_a_turned_image_is_named():
    _, warnings = first_look(open_source(CASES / "12-portrait-landscape-centre/rec"))
    assert any("fits an image of 160×120, these are 120×160" in warning for warning in warnings)
