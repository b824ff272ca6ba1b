"""Each remedy that is printed for a recording works as printed: an input triggers the message, the printed option is
given to the same command with the words in capitals filled in, or the printed file is written, and the message is gone.

Remedies that other tests follow: EXIF tags (test_image_files), lists instead of names (test_names_and_phones),
encodings of bags (test_lists_and_bags), commands after a run (test_ends), `calibrate` and the scale of poses
(tests/system)."""

import json
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import layouts
from bag_recordings import CAMERA_TOPICS, FOCAL, Recorder
from command_line import exit_code
from recorded_room import write_images
from recordings import r3d_members, scene, write_zip
from sigmasplat.plugins.checks import recording
from small_room import frame_at

SEEN = [frame_at(i) for i in range(0, 200, 50)]
FX, CENTRE, MM = ("--fx", "128"), ("--cx", "79.5", "--cy", "59.5"), ("--depth-scale", "1000")
CAMERA = {"fx": 128.0, "fy": 128.0, "cx": 79.5, "cy": 59.5}
Words = tuple[str, ...]


@dataclass(frozen=True)
class Remedy:
    """write: makes the recording in a folder, returns what is given to the command; given: options from the start;
    said: pattern of the complaint, which is gone afterwards; printed: pattern of the option in it, or None; filled: for
    the words in capitals, in order; mended: changes the files as printed, if no option is printed."""

    write: Callable[[Path], Path]
    said: str
    printed: str = ""
    filled: Words = ()
    given: Words = ()
    mended: Callable[[Path], object] = lambda path: None


def room(
    change: Callable[[np.ndarray, int], np.ndarray] = lambda z, i: z, floats: bool = False, **calibration: Any
) -> Callable[[Path], Path]:
    """Write a plain folder of the room whose depth, m, is changed, from depth and number of a frame."""

    def write(folder: Path) -> Path:
        seen = [
            replace(frame, depth_m=np.clip(change(frame.depth_m, i), 0, None).astype(np.float32))
            for i, frame in enumerate(SEEN)
        ]
        write_images(folder, SEEN if floats else seen)
        for i, frame in enumerate(seen if floats else []):
            (folder / f"depth/{i:04d}.png").unlink()
            np.save(folder / f"depth/{i:04d}.npy", frame.depth_m)
        if calibration:
            (folder / "calibration.json").write_text(json.dumps(calibration))
        return folder

    return write


def wall(z: np.ndarray, i: int) -> np.ndarray:
    """A table before a wall that is parallel to the image, 3 m away."""
    depth = np.full(z.shape, 3.0)
    depth[60:] = np.linspace(2.9, 1.2, 60)[:, None]
    depth[50:90, 30 + 4 * i : 60 + 4 * i] = 1.5
    return depth


def rough(z: np.ndarray, i: int) -> np.ndarray:
    return np.random.default_rng(i).uniform(1, 3, z.shape)


def holes_at_10_m(z: np.ndarray, i: int) -> np.ndarray:
    holes = np.zeros(z.shape, bool)
    holes[20:60, 30:40] = holes[::7, ::5] = True
    return np.where(holes, 10.0, z)


def listed_again(folder: Path, times: Callable[[int], float], late_s: float = 0.0) -> Path:
    for part, late in (("rgb", 0.0), ("depth", late_s)):
        lines = [f"{times(i) + late:.6f} {part}/{i:04d}.png\n" for i in range(len(SEEN))]
        (folder / f"{part}.txt").write_text("".join(lines))
    return folder


def listed(name: str, late_s: float = 0.0, times: Callable[[int], float] = lambda i: i / 15) -> Callable[[Path], Path]:
    """Write TUM's lists, in millimetres."""

    def write(folder: Path) -> Path:
        room()(folder / name)
        (folder / name / "color").rename(folder / name / "rgb")
        return listed_again(folder / name, times, late_s)

    return write


def transparent(folder: Path) -> Path:
    room(**CAMERA)(folder)
    for path in folder.glob("color/*.png"):
        image = Image.open(path).convert("RGBA")
        image.putpixel((0, 0), (0, 0, 0, 0))
        image.save(path)
    for i in range(len(SEEN)):
        layouts.save(folder.parent / f"masks/{i}.png", np.zeros((120, 160), np.uint8))
    return folder


def with_poses(folder: Path) -> Path:
    room(**CAMERA)(folder)
    lines = [f"{i / 30:.6f},{i / 10},0,0,0,0,0,1\n" for i in range(len(SEEN))]
    (folder / "camera_pose.csv").write_text("timestamp,tx,ty,tz,qx,qy,qz,qw\n" + "".join(lines))
    return folder


def dark_and_bright(folder: Path) -> Path:
    room(**CAMERA)(folder)
    for i, path in enumerate(sorted(folder.glob("color/*.png"))):
        image = np.asarray(Image.open(path)) // (1 + i % 2)
        Image.fromarray(image).save(path)
    return folder


def phone(folder: Path) -> Path:
    pytest.importorskip("lzfse", reason="Record3D needs the extra iphone")
    folder.mkdir()
    return write_zip(folder / "walk.r3d", r3d_members(scene()))


def bag(
    infos: Words = CAMERA_TOPICS, frames: Words = ("optical", "optical"), ros1: bool = False, model: str = "plumb_bob",
    small: bool = False, extra: Words = (),
) -> Callable[[Path], Path]:  # fmt: skip
    """Write a bag with camera_info for the topics `infos`; small: depth has fewer pixels; extra: more topics."""

    def write(folder: Path) -> Path:
        pytest.importorskip("rosbags", reason="bags need the extra ros")
        folder.mkdir()
        seen, recorder = scene((32, 24), (16, 12) if small else None), Recorder(ros1)
        topics = "/camera/color/image_raw", "/camera/depth/image_raw"
        for color, depth, t in zip(seen.colors, seen.depths_mm, seen.times_s, strict=True):
            recorder.image(topics[0], t, color, "rgb8", frames[0])
            recorder.image(topics[1], t, depth, "16UC1", frames[1])
            for name in extra:
                depth_too = "depth" in name
                recorder.image(name, t, depth if depth_too else color, "16UC1" if depth_too else "rgb8", frames[0])
        for topic, size, frame in zip(topics, ((32, 24), seen.depths_mm.shape[:0:-1]), frames, strict=True):
            if any(topic.split("/")[2] in info for info in infos):
                name, lens = topic.replace("image_raw", "camera_info"), (0.1, 0.0, 0.0, 0.0, 0.0)
                recorder.info(
                    name, seen.times_s[0], size, FOCAL, frame, lens if model != "plumb_bob" else (0.0,) * 5, model
                )
        return recorder.write(folder / ("walk.bag" if ros1 else "walk"))

    return write


def calibrate(**fields: Any) -> Callable[[Path], object]:
    """Return what adds fields to the calibration.json of a recording."""

    def mend(path: Path) -> None:
        file = path / "calibration.json"
        file.write_text(json.dumps((json.loads(file.read_text()) if file.exists() else {}) | fields))

    return mend


DEPTH_CAMERA = {"fx": 20.0, "fy": 20.0, "cx": 7.5, "cy": 5.5, "width": 16, "height": 12}
SMALL = {"fx": 40.0, "fy": 41.0, "cx": 15.0, "cy": 12.0, "width": 32, "height": 24}
BOTH = SMALL | {"depth_camera": DEPTH_CAMERA, "T_color_depth": np.eye(4).tolist()}
VGA = {"fx": 512.0, "fy": 512.0, "cx": 319.5, "cy": 239.5}
FILES = {"vga.json": VGA, "small.json": SMALL, "both.json": BOTH}
"""Files beside the recordings, for --calibration."""
REMEDIES = {
    "no camera": Remedy(room(), "camera unknown", r"--fx PIXELS", ("128",)),
    "no camera, all": Remedy(
        room(), "camera unknown", r"--fx PIXELS \(and --fy, --cx, --cy, --depth-scale\)",
        ("128", "128", "79.5", "59.5", "1000"),
    ),
    "no camera, a file": Remedy(
        room(), r"camera unknown: .*write \S+calibration.json with fx, fy, cx, cy", mended=calibrate(**CAMERA)
    ),
    "a bag without camera": Remedy(
        bag(infos=(), ros1=True), "camera unknown.*write a file for", "--calibration", ("small.json",)
    ),
    "a folder of a bag without camera": Remedy(
        bag(infos=()), r"camera unknown.*write \S+calibration.json", mended=calibrate(**SMALL)
    ),
    "image centre": Remedy(room(), "image centre: the middle", "--cx PX --cy PX", ("79.5", "59.5"), FX),
    "centre outside": Remedy(
        room(**CAMERA | {"cx": 400.0}), "principal point .* is outside", "--cx and --cy", ("79.5", "59.5")
    ),
    "centre of turned images": Remedy(
        room(**CAMERA | {"cx": 59.5, "cy": 79.5}), "the principal point .* fits an image of 120×160",
        "--fx, --fy, --cx, --cy", ("128", "128", "79.5", "59.5"),
    ),
    "impossible focal length": Remedy(room(**CAMERA | {"fx": 3.0}), "fx = 3 pixels gives", "--fx PIXELS", ("128",)),
    "impossible focal length, y": Remedy(room(**CAMERA | {"fy": 1.0}), "fy = 1 pixels gives", "--fy PIXELS", ("128",)),
    "published camera": Remedy(
        lambda folder: layouts.tum(folder, layouts.sample(layouts.VGA)), "camera: TUM's freiburg3",
        "--calibration FILE", ("vga.json",),
    ),
    "size of the calibration": Remedy(
        room(**CAMERA), r"size of the calibration: that of the images \(width and height in \S+calibration.json",
        mended=calibrate(width=160, height=120),
    ),
    "lens": Remedy(
        room(**CAMERA), r"lens: no distortion \(distortion in calibration.json",
        mended=calibrate(distortion=[0.001, 0, 0, 0, 0]),
    ),
    "one camera": Remedy(
        room(**CAMERA), r"one camera, registered \(depth_camera and T_color_depth in calibration.json",
        mended=calibrate(depth_camera=CAMERA, T_color_depth=np.eye(4).tolist()),
    ),
    "TUM's unit": Remedy(listed("desk"), "depth unit: 5000 per metre", "--depth-scale 1000", given=FX),
    "millimetres": Remedy(room(), "depth unit: 1000 per metre", "--depth-scale 5000", given=FX),
    "unit of floats": Remedy(room(floats=True), "metres, as usual for floats", "--depth-scale UNITS", ("1",), FX),
    "wrong unit": Remedy(
        room(**CAMERA | {"depth_scale": 1.0}), "the depth's scale looks wrong", r"--depth-scale 1000",
    ),
    "unknown unit": Remedy(
        room(lambda z, i: 1e6 * z, floats=True), "the depth's scale looks wrong; give", "--depth-scale UNITS", ("1e6",),
        FX,
    ),
    "normalised": Remedy(
        room(lambda z, i: z / z.max(), floats=True), "depth is normalised", "--depth-scale 0.1", given=FX
    ),
    "normalised, each image": Remedy(
        room(lambda z, i: z / z.max(), floats=True), "depth is normalised", "--predicted-depth FOLDER",
        ("rec/depth",), FX,
    ),
    "inverse depth": Remedy(
        room(lambda z, i: 1 / np.maximum(z, 0.1)), "depth is stored as inverse depth",
        "--predicted-depth FOLDER --predicted-inverse", ("rec/depth",), FX + CENTRE,
    ),
    "meaning of depth": Remedy(
        room(rough), "depth: along the optical axis", r"--set input.depth_along=ray", given=FX + CENTRE
    ),
    "holes as a farthest value": Remedy(
        room(holes_at_10_m), "these and larger ones are dropped", "--set input.depth_along=z", given=FX + CENTRE
    ),
    "a farthest value": Remedy(
        room(wall), "if these are no readings", r"--set input.max_depth_m=[.0-9]+", given=FX + CENTRE
    ),
    "far away": Remedy(
        room(lambda z, i: 5 * z), "are beyond 8 m and are not used", "--set input.max_depth_m=METRES", ("40",),
        FX + CENTRE,
    ),
    "transparency": Remedy(transparent, "transparency: ignored", "--masks FOLDER", ("masks",)),
    "poses beside": Remedy(with_poses, "poses: none, camera_pose.csv is not read", r"--poses \S+camera_pose.csv"),
    "late depth": Remedy(
        listed("desk", 0.03), "is stamped 0.030 s late", r"--set input.depth_delay_s=[.0-9]+", given=FX + MM
    ),
    "late depth as it is": Remedy(
        listed("desk", 0.03), "is stamped 0.030 s late", r"--set input.max_gap_s=[.0-9]+", given=FX + MM
    ),
    "gaps": Remedy(
        listed("desk", times=lambda i: i / 15 + 9 * (i > 2)), "1 gaps in time", "--start and --end", ("0", "1"), FX + MM
    ),
    "times in ms": Remedy(
        listed("desk", times=lambda i: 66.0 * i), "frames per second; write times in seconds", given=FX + MM,
        mended=lambda path: listed_again(path, lambda i: 0.066 * i),
    ),
    "times that go back": Remedy(
        listed("desk", times=lambda i: (0.0, 0.1, 0.1001, 0.1001)[i]), "the same time as the frame before",
        given=FX + MM, mended=lambda path: listed_again(path, lambda i: 0.1 * i),
    ),
    "brightness": Remedy(dark_and_bright, "brightness changes by", "--set tracking.exposure=true"),
    "colour topics": Remedy(
        bag(extra=("/other/color/image_raw",)), "several topics hold colour", "--color-topic NAME",
        ("/camera/color/image_raw",),
    ),
    "depth topics": Remedy(
        bag(extra=("/other/depth/image_raw",)), "several topics hold depth", "--depth-topic NAME",
        ("/camera/depth/image_raw",),
    ),
    "no camera_info of depth": Remedy(
        bag(infos=("/color/",), frames=("a", "b"), small=True), "so it cannot be registered", "--calibration FILE",
        ("both.json",),
    ),
    "no transform": Remedy(
        bag(infos=("/color/", "/depth/"), frames=("a", "b"), small=True), "no transform from the depth camera",
        "--calibration FILE", ("both.json",),
    ),
    "lens of a bag": Remedy(
        bag(infos=("/color/",), model="equidistant"), "lens model equidistant is not supported", "--calibration FILE",
        ("small.json",),
    ),
}  # fmt: skip


def inspected(path: Path, options: Words, capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Run `sigmasplat inspect`; return its exit code and all that it prints."""
    capfd.readouterr()
    code = exit_code("inspect", str(path), *options, "--out", str(path.parent / "sheet.png"))
    return code, "\n".join(capfd.readouterr())


def filled(printed: str, values: Words, folder: Path) -> Words:
    """Return the words of printed options, with values for those in capitals, or after options without a value."""
    left, words = list(values), list[str]()
    for word in re.sub(r"\(and |and |[,)]", " ", printed).split():
        words += [word] if not (word.isupper() and word.isalpha()) else []
        if left and word.startswith("--") and word not in ("--set", "--predicted-inverse"):
            value = left.pop(0)
            beside = folder / value
            words.append(str(beside) if beside.exists() else value)
        elif word.startswith("input.") and left:
            words[-1] = word.replace("METRES", left.pop(0))
    return tuple(shlex.split(" ".join(words)))


@pytest.mark.parametrize("kind", REMEDIES)
def test_a_printed_remedy_removes_its_complaint(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "2000")
    monkeypatch.setattr(recording, "SHOWN", 1)  # faster
    monkeypatch.setattr(recording, "edge_agreement", lambda frames: None)
    for name, fields in FILES.items():
        (tmp_path / name).write_text(json.dumps(fields))
    remedy = REMEDIES[kind]
    path = remedy.write(tmp_path / "rec")
    _, said = inspected(path, remedy.given, capfd)
    line = next((line for line in said.splitlines() if re.search(remedy.said, line)), None)
    assert line, f"no complaint {remedy.said!r} in\n{said}"
    option: Words = ()
    if remedy.printed:
        printed = re.search(remedy.printed, line)
        assert printed, line
        option = filled(printed[0], remedy.filled, tmp_path)
    remedy.mended(path)
    code, now = inspected(path, remedy.given + option, capfd)
    assert code in (0, 1), f"{option} is refused:\n{now}"
    assert not re.search(remedy.said, now), f"{option} does not remove\n{line}\nfrom\n{now}"


def test_poses_of_a_phone_can_be_used_as_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = phone(tmp_path / "rec")
    _, said = inspected(path, (), capfd)
    assert "--poses recorded" in " ".join(said.split())
    assert inspected(path, ("--poses", "recorded"), capfd)[0] in (0, 1)
