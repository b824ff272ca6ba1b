"""Videos, colour images and recordings with depth that a network predicted."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from sigmasplat.errors import SourceError
from sigmasplat.input.calibration import CameraUnknown
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

ROOM = "synthetic:frames=60,width=64,height=48"
FRAMES = 6
FX = 55.0


def images(folder: Path, names: list[str]) -> list[np.ndarray]:
    """Write colour images of the room, and return the depth of each."""
    room, depths = open_source(ROOM), []
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        frame = room.frame(i)
        Image.fromarray(np.rint(frame.color * 255.0).astype(np.uint8)).save(folder / f"{name}.png")
        depths.append(frame.depth_m)
    return depths


def predicted(folder: Path, names: list[str], depths: list[np.ndarray]) -> str:
    """Write depth of an arbitrary unit."""
    folder.mkdir()
    for name, depth in zip(names, depths, strict=True):
        np.save(folder / f"{name}.npy", 1000.0 * depth)
    return str(folder)


NAMES = [f"img_{i}" for i in range(FRAMES)]


@pytest.mark.parametrize("inside", [".", "rgb"])
def test_colour_images_get_depth_of_their_names_at_the_size_of_a_room(tmp_path: Path, inside: str) -> None:
    depths = images(tmp_path / "photos" / inside, NAMES) if inside != "." else images(tmp_path / "photos", NAMES)
    folder = predicted(tmp_path / "depth", [*NAMES, "img_99"], [depth[::2, ::2] for depth in [*depths, depths[0]]])
    source = open_source(tmp_path / "photos", predicted_depth=folder, fx=FX)
    assert len(source) == FRAMES and source.predicted_depth and source.camera.fx == FX
    assert source.timestamp_s(3) == pytest.approx(0.1)
    factor = 2.0 / np.median(depths[0][::2, ::2])
    for i, depth in enumerate(depths):
        frame = source.frame(i)
        assert frame.depth_m.shape == depth.shape
        np.testing.assert_allclose(frame.depth_m[::2, ::2], factor * depth[::2, ::2], rtol=1e-5)
        np.testing.assert_array_equal(source.depth_of(i), frame.depth_m)


def test_depth_in_metres_keeps_its_scale_and_a_recording_keeps_its_camera(tmp_path: Path) -> None:
    room = open_source(ROOM)
    (tmp_path / "depth").mkdir()
    for i in range(60):
        np.save(tmp_path / "depth" / f"{i}.npy", np.full((48, 64), 1.0 + 0.01 * i, np.float32))
    source = open_source(ROOM, predicted_depth=str(tmp_path / "depth"), stride=2, limit=4)
    assert source.camera == room.camera and source.predicted_depth and len(source) == 4
    assert source.frame(3).depth_m == pytest.approx(1.06) and source.depth_of(3) == pytest.approx(1.06)
    assert source.truth() is not None


def test_inverse_depth_of_whole_numbers(tmp_path: Path) -> None:
    depths = images(tmp_path / "photos", NAMES)
    (tmp_path / "disparity").mkdir()
    for name, depth in zip(NAMES, depths, strict=True):
        disparity = np.rint(40_000.0 / depth).astype(np.uint16)
        disparity[:4] = 0
        Image.fromarray(disparity).save(tmp_path / "disparity" / f"{name}.png")
    given = {"predicted_depth": str(tmp_path / "disparity"), "predicted_inverse": True, "fx": FX}
    source = open_source(tmp_path / "photos", **given)
    for i in (0, 4):
        found = source.frame(i).depth_m
        assert (found[:4] == 0).all()
        ratio = found[4:] / depths[i][4:]
        assert ratio.std() < 1e-3 * ratio.mean()
    assert np.median(source.depth_of(0)[4:]) == pytest.approx(2.0, rel=1e-3)


def test_a_video(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV writes the video")
    room, path = open_source(ROOM), str(tmp_path / "walk.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(FRAMES):
        video.write(np.rint(room.frame(i).color[..., ::-1] * 255.0).astype(np.uint8))
    video.release()
    folder = predicted(tmp_path / "depth", NAMES, [room.frame(i).depth_m for i in range(FRAMES)])
    with pytest.raises(CameraUnknown):
        open_source(path, predicted_depth=folder)
    source = open_source(path, predicted_depth=folder, fx=FX)
    assert len(source) == FRAMES and source.timestamp_s(2) == pytest.approx(0.2)
    assert np.abs(source.frame(2).color - room.frame(2).color).mean() < 0.05
    with pytest.raises(SourceError, match="no depth"):
        open_source(path, fx=FX)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "img_3.npy").unlink(), "no predicted depth for 1 of 6 frames"),
        (lambda folder: (folder / "img_0.npy").unlink(), "5 frames, there are 6"),
        (lambda folder: [path.unlink() for path in folder.iterdir()], "0 frames, there are 6"),
        (lambda folder: np.save(folder / "img_0.npy", np.full((48, 64), np.nan)), "NaN or inf"),
        (lambda folder: np.save(folder / "img_0.npy", np.zeros((48, 64))), "no value above 0"),
        (lambda folder: np.save(folder / "img_0.npy", np.zeros((48, 64, 3))), "one number for each pixel"),
        (lambda folder: (folder / "img_0.npy").write_bytes(b"no array"), "img_0.npy"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(tmp_path: Path, change, message: str) -> None:
    folder = predicted(tmp_path / "depth", NAMES, images(tmp_path / "photos", NAMES))
    change(Path(folder))
    with pytest.raises(SourceError, match=message) as found:
        open_source(tmp_path / "photos", predicted_depth=folder, fx=FX)
    assert "\n" not in str(found.value)


def test_inspect_checks_images_with_predicted_depth_and_takes_no_unit_from_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depths = images(tmp_path / "rgb", NAMES)
    folder = predicted(tmp_path / "depth", NAMES, depths)
    words = ("inspect", str(tmp_path / "rgb"), "--predicted-depth", folder, "--set", f"input.fx={FX}")
    assert exit_code(*words, "--out", str(tmp_path / "sheet.png")) in (0, 1)
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "colour only, with predicted depth" in shown and f"{FRAMES}, " in shown
    assert "arbitrary: a network predicted depth" in shown and (tmp_path / "sheet.png").stat().st_size > 0


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such folder"):
        open_source(ROOM, predicted_depth=str(tmp_path / "none"))


@pytest.mark.slow
def test_a_run_of_colour_images_ends_with_a_map_and_says_that_its_scale_is_arbitrary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = predicted(tmp_path / "depth", NAMES, images(tmp_path / "photos", NAMES))
    out, quick = tmp_path / "run", ["mapping.first_iterations=5", "mapping.iterations=2", "final.iterations=2"]
    more = ["--predicted-depth", folder, "--fx", str(FX), "--out", str(out)]
    assert exit_code("run", str(tmp_path / "photos"), *more, *(word for s in quick for word in ("--set", s))) == 0
    assert "scale is arbitrary" in " ".join(capsys.readouterr().out.split())
    run = RunFolder(out)
    assert run.facts()["predicted_depth"] and run.config().tracking.fit_depth and len(run.read_map())
    assert run.config().input.predicted_depth == folder
    assert exit_code("eval", str(out)) == 0
