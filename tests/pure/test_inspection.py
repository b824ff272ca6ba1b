"""What `inspect` says of a sequence, and that it notices what would spoil a map."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from sigmasplat.checks.recording import inspect_source
from sigmasplat.checks.registration import edge_agreement, outlines
from sigmasplat.config import InputConfig
from sigmasplat.model.camera import Camera
from sigmasplat.sources import open_source
from sigmasplat.sources.camera.depth_registration import DepthRegistration
from sigmasplat.sources.tum import write_tum

ROOM = "synthetic:frames=120,width=320,height=240"
SEEN = InputConfig(stride=12)


@pytest.fixture(scope="module")
def frames():
    return list(open_source(ROOM, SEEN))


def unregistered(frame):
    """Return the frame with depth as a camera of longer focal length, 25 mm to the side, would have it."""
    c = frame.camera
    T = np.eye(4)
    T[0, 3] = 0.025
    depth_camera = replace(c, fx=1.1 * c.fx, fy=1.1 * c.fy)
    return replace(frame, depth_m=DepthRegistration(c, depth_camera, T)(frame.depth_m))


def test_colour_and_depth_of_one_camera_agree(frames):
    found = edge_agreement(frames)
    assert found.known and found.registered and found.score > 0.95
    assert found.magnification == 0.0 and np.abs(found.shift_px).max() <= 1.0


def test_depth_of_another_camera_is_detected_and_a_fix_is_suggested(frames):
    found = edge_agreement([unregistered(frame) for frame in frames])
    assert found.known and not found.registered and found.score < 0.5
    assert found.magnification == pytest.approx(1 / 1.1 - 1, abs=0.03)
    assert "magnified by -" in found.sentence()


def test_blank_images_give_no_finding(frames):
    wall = replace(frames[0], depth_m=np.full_like(frames[0].depth_m, 2.0))
    assert edge_agreement([wall]) is None
    noise = np.random.default_rng(0).uniform(1, 4, wall.depth_m.shape).astype(np.float32)
    gray = replace(wall, depth_m=noise, color=np.full_like(wall.color, 0.5))
    assert edge_agreement([gray]).registered, "no edges in the image: no verdict"


def test_outlines_lie_on_the_nearer_side_and_not_on_a_shadows_far_border():
    depth = np.full((20, 40), 3.0, np.float32)
    depth[:, 20:30] = 1.0
    depth[:, 16:20] = 0.0  # the shadow beside it
    found = outlines(depth)[10]
    assert found[20] and found[29], "the object's own borders"
    assert not found[10:20].any() and not found[30:].any()


def test_rows_tell_what_is_there(tiny_tum):
    found = inspect_source(tiny_tum, InputConfig())
    rows = dict(found.rows)
    assert rows["format"] == "TUM" and rows["frames"].startswith("4, 10.0 per second")
    assert rows["size"] == "32×24 pixels" and rows["depth unit"] == "1000 per metre"
    assert rows["depth"].startswith("2.00 to 2.00 m") and rows["without reading"] == "0% of the pixels"
    assert rows["poses"] == "4 true poses, 3.0 m long"
    assert rows["suggested preset"].startswith("sigma") and "-tum" in rows["suggested preset"]
    assert rows["depth's camera"] == "the colour camera's, as recorded" and "your depth scale" not in rows
    assert found.warnings == []
    assert np.asarray(found.sheet).std() > 10


def test_an_implausible_depth_scale_of_the_user_gives_a_warning(tiny_tum):
    rows = dict(inspect_source(tiny_tum, InputConfig(depth_scale=2500.0)).rows)
    assert rows["depth unit"] == "2500 per metre"
    assert rows["your depth scale"] == "half of what is seen is nearer than 0.80 m: is that so?"


def damage(folder, value, share):
    for path in (folder / "depth").iterdir():
        depth = np.full((24, 32), value, np.uint16)
        depth.reshape(-1)[: int(share * depth.size)] = 0
        Image.fromarray(depth).save(path)


@pytest.mark.parametrize(
    "value, share, words",
    [(2000, 0.8, "80% of the pixels have no depth"), (20, 0, "depth's scale looks wrong"), (9500, 0, "beyond 8 m")],
)
def test_what_would_spoil_a_map_is_warned_of(tiny_tum, value, share, words):
    damage(tiny_tum, value, share)
    assert any(words in warning for warning in inspect_source(tiny_tum, InputConfig()).warnings)


def test_changing_brightness_is_warned_of(tiny_tum):
    for i, path in enumerate(sorted((tiny_tum / "rgb").iterdir())):
        Image.fromarray(np.full((24, 32, 3), 60 + 120 * (i % 2), np.uint8)).save(path)
    assert any("tracking.exposure" in warning for warning in inspect_source(tiny_tum, InputConfig()).warnings)


def test_a_recording_without_a_camera_is_looked_at_all_the_same(tiny_tum):
    (tiny_tum / "calibration.json").unlink()
    found = inspect_source(tiny_tum, InputConfig(depth_scale=1000.0))
    assert any("camera unknown" in warning and "as if fx were 29 pixels" in warning for warning in found.warnings)
    assert dict(found.rows)["size"] == "32×24 pixels"


def test_an_unreadable_frame_is_counted_not_fatal(tiny_tum):
    (tiny_tum / "rgb/2.png").write_bytes(b"x")
    assert "1 files" in dict(inspect_source(tiny_tum, InputConfig()).rows)["left out"]


def test_the_command_prints_and_draws(tiny_tum, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert exit_code("inspect", str(tiny_tum)) == 0
    assert "2.00 to 2.00 m" in capsys.readouterr().out
    assert Image.open(tmp_path / "runs/inspect/tiny.png").width > 500
    damage(tiny_tum, 20, 0)
    assert exit_code("inspect", str(tiny_tum), "--out", str(tmp_path / "sheet.png")) == 1
    assert "scale looks wrong" in capsys.readouterr().err
    assert exit_code("inspect", str(tiny_tum), "--depth-scale", "10", "--out", str(tmp_path / "sheet.png")) == 0


class Unregistered:
    """A source's frames with depth of another camera."""

    def __init__(self, source):
        self.source = source

    def __getattr__(self, name):
        return getattr(self.source, name)

    def __iter__(self):
        return map(unregistered, self.source)


def test_unregistered_depth_is_detected_and_the_named_option_fixes_it(tmp_path):
    room = open_source("synthetic:frames=120,width=320,height=240", stride=15)
    write_tum(Unregistered(room), tmp_path / "two")
    first = inspect_source(tmp_path / "two", InputConfig())
    assert any("not registered to colour" in warning and "T_color_depth" in warning for warning in first.warnings)
    fields = json.loads((tmp_path / "two/calibration.json").read_text())
    camera, T_color_depth = room.camera, np.eye(4)
    T_color_depth[0, 3] = -0.025
    fields["depth_camera"] = {key: fields[key] for key in ("cx", "cy", "width", "height")}
    fields["depth_camera"] |= {"fx": 1.1 * camera.fx, "fy": 1.1 * camera.fy}
    (tmp_path / "two/calibration.json").write_text(json.dumps(fields | {"T_color_depth": T_color_depth.tolist()}))
    mended = inspect_source(tmp_path / "two", InputConfig())
    assert mended.warnings == [] and mended.agreement.score > 0.9
    assert dict(mended.rows)["depth's camera"] == "its own: moved to the colour camera here"
    refused = inspect_source(tmp_path / "two", InputConfig(register_depth="off"))
    assert any("--register-depth on" in warning for warning in refused.warnings)
    assert dict(refused.rows)["depth's camera"] == "its own: not moved, as --register-depth off asks"


@pytest.mark.parametrize("name", ["redkitchen", "cubicles", "hololens", "livingroom"])
def test_real_registered_recordings_pass(data_folder, name):
    found = inspect_source(data_folder(name), InputConfig())
    assert found.warnings == [] and found.agreement.registered


def test_a_real_recording_of_two_cameras_is_noticed(data_folder):
    """Depth as 7-Scenes publishes it: without the option a warning that names it, with it none."""
    folder = data_folder("redkitchen_raw")
    assert any("--register-depth on" in warning for warning in inspect_source(folder, InputConfig()).warnings)
    assert inspect_source(folder, InputConfig(register_depth="on")).warnings == []


def test_the_comparison_works_at_any_size(frames):
    small = [frame.resized(200, 150) for frame in frames]
    assert edge_agreement(small).score > 0.9
    assert isinstance(small[0].camera, Camera)
