"""What `inspect` reports about a recording, and that it warns of what degrades a map."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from paper_settings import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.input.rectification import DepthRegistration
from sigmasplat.plugins.checks import recording
from sigmasplat.plugins.checks.depth import edge_agreement, outlines
from sigmasplat.plugins.checks.recording import inspect_source
from sigmasplat.plugins.sources import open_source
from tum_recording import write_tum

ROOM = "synthetic:frames=120,width=320,height=240"
SEEN = InputConfig(stride=12)


@pytest.fixture(scope="module")
def frames():
    return list(open_source(ROOM, SEEN))


@pytest.fixture
def without_comparison(monkeypatch):
    """Leave out the comparison of edges, the longest part of an inspection."""
    monkeypatch.setattr(recording, "edge_agreement", lambda frames: None)


def unregistered(frame):
    """Return the frame with depth of another camera: longer focal length, 25 mm to the side."""
    c = frame.camera
    T = np.eye(4)
    T[0, 3] = 0.025
    depth_camera = replace(c, fx=1.1 * c.fx, fy=1.1 * c.fy)
    return replace(frame, depth_m=DepthRegistration(c, depth_camera, T)(frame.depth_m))


def test_colour_and_depth_of_one_camera_agree(frames):
    found = edge_agreement(frames)
    assert found.known and found.registered and found.score > 0.95
    assert found.magnification == 0.0 and np.abs(found.shift_px).max() <= 1.0


def test_depth_of_another_camera_is_detected_with_its_correction(frames):
    found = edge_agreement([unregistered(frame) for frame in frames])
    assert found.known and not found.registered and found.score < 0.5
    assert found.magnification == pytest.approx(1 / 1.1 - 1, abs=0.03)
    assert "magnified by -" in found.sentence()


def test_without_outlines_or_edges_the_result_is_unknown(frames):
    wall = replace(frames[0], depth_m=np.full_like(frames[0].depth_m, 2.0))
    assert edge_agreement([wall]) is None
    noise = np.random.default_rng(0).uniform(1, 4, wall.depth_m.shape).astype(np.float32)
    gray = replace(wall, depth_m=noise, color=np.full_like(wall.color, 0.5))
    assert edge_agreement([gray]).registered, "no edges in the image: unknown"


def test_outlines_are_on_the_near_side_and_not_on_the_far_border_of_a_shadow():
    depth = np.full((20, 40), 3.0, np.float32)
    depth[:, 20:30] = 1.0
    depth[:, 16:20] = 0.0  # shadow of the object
    found = outlines(depth)[10]
    assert found[20] and found[29], "borders of the object"
    assert not found[10:20].any() and not found[30:].any()


def test_rows_describe_the_recording(tiny_tum):
    found = inspect_source(tiny_tum, InputConfig())
    rows = dict(found.rows)
    assert rows["format"] == "TUM" and rows["frames"].startswith("4, 10.0 per second")
    assert rows["size"] == "32×24 pixels" and rows["depth unit"] == "1000 per metre"
    assert rows["depth"].startswith("2.00 to 2.00 m") and rows["without depth"] == "0% of the pixels"
    assert rows["poses"] == "4 true poses, 3.0 m long"
    assert rows["suggested preset"].startswith("sigma") and "-tum" in rows["suggested preset"]
    assert rows["depth camera"] == "same as colour, according to the recording" and "your depth scale" not in rows
    assert found.warnings == []
    assert np.asarray(found.sheet).std() > 10


@pytest.mark.usefixtures("without_comparison")
def test_a_given_depth_scale_is_questioned(tiny_tum):
    rows = dict(inspect_source(tiny_tum, InputConfig(depth_scale=2500.0)).rows)
    assert rows["depth unit"] == "2500 per metre"
    assert rows["your depth scale"] == "it gives a median depth of 0.80 m: is this plausible?"


def damage(folder, value, share):
    for path in (folder / "depth").iterdir():
        depth = np.full((24, 32), value, np.uint16)
        depth.reshape(-1)[: int(share * depth.size)] = 0
        Image.fromarray(depth).save(path)


@pytest.mark.usefixtures("without_comparison")
@pytest.mark.parametrize(
    "value, share, words",
    [(2000, 0.8, "80% of the pixels have no depth"), (20, 0, "depth's scale looks wrong"), (9500, 0, "beyond 8 m")],
)
def test_depth_that_degrades_a_map_gives_a_warning(tiny_tum, value, share, words):
    damage(tiny_tum, value, share)
    assert any(words in warning for warning in inspect_source(tiny_tum, InputConfig()).warnings)


@pytest.mark.usefixtures("without_comparison")
def test_changing_brightness_gives_a_warning(tiny_tum):
    for i, path in enumerate(sorted((tiny_tum / "rgb").iterdir())):
        Image.fromarray(np.full((24, 32, 3), 60 + 120 * (i % 2), np.uint8)).save(path)
    assert any("tracking.exposure" in warning for warning in inspect_source(tiny_tum, InputConfig()).warnings)


@pytest.mark.usefixtures("without_comparison")
def test_a_recording_with_unknown_camera_is_inspected_with_a_typical_one(tiny_tum):
    (tiny_tum / "calibration.json").unlink()
    found = inspect_source(tiny_tum, InputConfig(depth_scale=1000.0))
    assert any("camera unknown" in warning and "assumes fx = 29 pixels" in warning for warning in found.warnings)
    assert dict(found.rows)["size"] == "32×24 pixels"


@pytest.mark.usefixtures("without_comparison")
def test_an_unreadable_frame_is_skipped_and_counted(tiny_tum):
    (tiny_tum / "rgb/2.png").write_bytes(b"x")
    assert "1 files" in dict(inspect_source(tiny_tum, InputConfig()).rows)["skipped"]


def test_the_command_prints_rows_and_draws_a_contact_sheet(tiny_tum, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code("inspect", str(tiny_tum)) == 0
    assert "2.00 to 2.00 m" in capsys.readouterr().out
    assert Image.open(tmp_path / "runs/inspect/tiny.png").width > 500
    damage(tiny_tum, 20, 0)
    assert exit_code("inspect", str(tiny_tum), "--out", str(tmp_path / "sheet.png")) == 1
    assert "scale looks wrong" in capsys.readouterr().err
    assert exit_code("inspect", str(tiny_tum), "--depth-scale", "10", "--out", str(tmp_path / "sheet.png")) == 0


class Unregistered:
    """The frames of a source, with depth of another camera."""

    def __init__(self, source):
        self.source = source

    def __getattr__(self, name):
        return getattr(self.source, name)

    def __iter__(self):
        return map(unregistered, self.source)


def test_unregistered_depth_is_detected_and_the_suggested_fix_works(tmp_path):
    room = open_source(ROOM, stride=24)
    write_tum(Unregistered(room), tmp_path / "two")
    first = inspect_source(tmp_path / "two", InputConfig())
    assert any("not registered to colour" in warning and "T_color_depth" in warning for warning in first.warnings)
    fields = json.loads((tmp_path / "two/calibration.json").read_text())
    camera, T_color_depth = room.camera, np.eye(4)
    T_color_depth[0, 3] = -0.025
    fields["depth_camera"] = {key: fields[key] for key in ("cx", "cy", "width", "height")}
    fields["depth_camera"] |= {"fx": 1.1 * camera.fx, "fy": 1.1 * camera.fy}
    (tmp_path / "two/calibration.json").write_text(json.dumps(fields | {"T_color_depth": T_color_depth.tolist()}))
    fixed = inspect_source(tmp_path / "two", InputConfig())
    assert fixed.warnings == [] and fixed.agreement.score > 0.9
    assert dict(fixed.rows)["depth camera"] == "separate; SigmaSplat registers depth to colour"
    off = inspect_source(tmp_path / "two", InputConfig(register_depth="off"))
    assert any("--register-depth on" in warning for warning in off.warnings)
    assert dict(off.rows)["depth camera"] == "separate; depth is not registered (--register-depth off)"


@pytest.mark.parametrize(
    "name",
    ["cubicles", *(pytest.param(name, marks=pytest.mark.slow) for name in ("redkitchen", "hololens", "livingroom"))],
)
def test_real_registered_recordings_have_no_warnings(data_folder, name):
    found = inspect_source(data_folder(name), InputConfig())
    assert found.warnings == [] and found.agreement.registered


@pytest.mark.slow
def test_unregistered_depth_of_a_real_recording_is_detected(data_folder):
    """Raw depth of 7-Scenes: without --register-depth there is a warning that names it, with it none."""
    folder = data_folder("redkitchen_raw")
    assert any("--register-depth on" in warning for warning in inspect_source(folder, InputConfig()).warnings)
    assert inspect_source(folder, InputConfig(register_depth="on")).warnings == []


def test_the_comparison_works_at_any_image_size(frames):
    small = [frame.resized(200, 150) for frame in frames]
    assert edge_agreement(small).score > 0.9
    assert isinstance(small[0].camera, Camera)
