"""Damaged and hostile files of every kind that once ended in a traceback, a hang or too much memory: one line each."""

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

import layouts
from room_run import made_run
from sigmasplat import cli
from sigmasplat.config import Config
from sigmasplat.errors import ConfigError, RunError, SourceError
from sigmasplat.input.lists import associate
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

DEEP = "[" * 200_000


def tum(folder: Path) -> Path:
    path = layouts.tum(folder, layouts.sample())
    fields = asdict(layouts.SMALL_CAMERA) | {"depth_scale": 5000}
    layouts.save_text(path / "calibration.json", json.dumps(fields))
    return path


def nerfstudio(folder: Path, **changes: object) -> Path:
    path = layouts.nerfstudio(folder, layouts.sample())
    fields = json.loads((path / "transforms.json").read_text())
    for name in ("fl_x", "fl_y"):
        del fields[name]
    (path / "transforms.json").write_text(json.dumps(fields | changes))
    return path


def written(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(path: Path | str, **settings: object) -> str:
    with pytest.raises((SourceError, ConfigError)) as caught:
        source = open_source(path, **settings)
        source.frame(0)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def png_header(width: int, height: int) -> bytes:
    """Return a PNG of one colour whose pixels would take much memory."""
    memory = io.BytesIO()
    Image.new("1", (width, height)).save(memory, "PNG")
    return memory.getvalue()


def each_image(folder: Path, content: bytes) -> None:
    for path in folder.glob("*/*.png"):
        path.write_bytes(content)


def eps(folder: Path) -> None:
    memory = io.BytesIO()
    Image.new("RGB", (32, 24)).save(memory, "EPS")
    each_image(folder, memory.getvalue())


TUM: dict[str, tuple[Callable[[Path], object], str]] = {
    "list that is not UTF-8": (lambda p: written(p / "rgb.txt", b"1 rgb/\xff.png\n"), "rgb.txt:1"),
    "list that is UTF-16": (lambda p: written(p / "rgb.txt", "1 rgb/a.png\n".encode("utf-16")), "save it as UTF-8"),
    "pipe as list": (lambda p: ((p / "rgb.txt").unlink(), os.mkfifo(p / "rgb.txt")), "a pipe"),
    "broken link as truth": (lambda p: ((p / "groundtruth.txt").unlink(), (p / "groundtruth.txt").symlink_to("no")),
                             "groundtruth.txt"),
    "truth of 1e400": (lambda p: written(p / "groundtruth.txt", "0 1e400 0 0 0 0 0 1\n"), "groundtruth.txt:1"),
    "number of 400 digits": (lambda p: written(p / "rgb.txt", "1" * 400 + " rgb/a.png\n"), "not finite"),
    "calibration nested too deep": (lambda p: written(p / "calibration.json", DEEP), "nested too deep"),
    "calibration of 5000 digits": (lambda p: written(p / "calibration.json", '{"fx": ' + "1" * 5000 + "}"), "JSON"),
    "focal length of 400 digits": (lambda p: written(p / "calibration.json", '{"fx": ' + "1" * 400 + "}"), "JSON"),
    "image of 12000² pixels": (lambda p: each_image(p, png_header(12000, 12000)), "pixels"),
    "EPS as PNG": (eps, "not JPEG, PNG"),
    "name that is too long": (lambda p: written(p / "rgb.txt", f"1305031102.175304 {'a' * 300}\n"), "a" * 100),
    "name with NUL": (lambda p: written(p / "rgb.txt", "1305031102.175304 a\0b\n"), "rgb"),
}  # fmt: skip


@pytest.mark.parametrize("kind", TUM)
def test_files_of_a_recording(kind: str, tmp_path: Path) -> None:
    path = tum(tmp_path)
    damage, says = TUM[kind]
    damage(path)
    assert says in refused(path)


def test_a_byte_order_mark_is_accepted(tmp_path: Path) -> None:
    path = tum(tmp_path)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt", "calibration.json"):
        written(path / name, b"\xef\xbb\xbf" + (path / name).read_bytes())
    assert len(open_source(path)) == layouts.FRAMES


def test_a_device_as_calibration(tmp_path: Path) -> None:
    assert "a device" in refused(tum(tmp_path), calibration="/dev/zero")


def test_a_field_of_view_of_zero(tmp_path: Path) -> None:
    assert "camera_angle_x" in refused(nerfstudio(tmp_path, camera_angle_x=0))


def test_many_frames_in_transforms_json(tmp_path: Path) -> None:
    frame = {"file_path": "images/frame_8.png", "transform_matrix": np.eye(4).tolist()}
    path = nerfstudio(tmp_path, frames=[frame] * 300_000)
    assert "transforms.json" in refused(path)


@pytest.mark.parametrize("content", [
    b"\x93NUMPY\x01\0\x40\0{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000)}",
    b"\x93NUMPY\x01\0\x30\0{'descr': '<f4', 'fortran_order': False, 'shape': ()}",
    b"\x93NUMPY\x01\0\x34\0{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 5)}",
    b"PK\x03\x04 the bytes of an archive",
    b"",
], ids=["huge", "no dimension", "negative", "zip", "empty"])  # fmt: skip
def test_depth_arrays(content: bytes, tmp_path: Path) -> None:
    path = layouts.plain(tmp_path, layouts.sample())
    for depth in (path / "depth").glob("*.png"):
        depth.unlink()
        written(depth.with_suffix(".npy"), content)
    assert ".npy" in refused(path)


def test_equal_times_do_not_need_memory_of_their_square() -> None:
    with pytest.raises(SourceError, match="own time"):
        associate(np.zeros(8000), np.zeros(8000))


def test_a_log_that_is_a_folder(tmp_path: Path) -> None:
    path = layouts.redwood(tmp_path, layouts.sample((640, 480)))
    (path / "00021.log").unlink()
    (path / "x.log").mkdir()
    assert open_source(path).truth() is None


def test_digits_that_are_no_decimal_number(tmp_path: Path) -> None:
    path = layouts.plain(tmp_path, layouts.sample())
    (path / "color/8.png").rename(path / "color/1²2.png")
    assert len(open_source(path)) > 0


@pytest.mark.parametrize("name", ["encrypted", "bomb", "deep"])
def test_archives_of_record3d(name: str, tmp_path: Path) -> None:
    text = {"encrypted": b"{}", "bomb": b"[" + b" " * (64 << 20), "deep": DEEP.encode()}[name]
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", text)
        archive.writestr("rgbd/0.jpg", b"x")
        archive.writestr("rgbd/0.depth", b"x")
    data = bytearray(memory.getvalue())
    if name == "encrypted":
        for start in (b"PK\x01\x02", b"PK\x03\x04"):
            at, flags = data.index(start), 8 if start == b"PK\x01\x02" else 6
            data[at + flags] |= 1
    assert "metadata" in refused(written(tmp_path / "walk.r3d", bytes(data)))


@pytest.mark.parametrize("change", [b"\xff", b"x" * 140_000], ids=["not UTF-8", "long field"])
def test_tables_of_stray_scanner(change: bytes, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from recordings import scene, write_stray

    path = write_stray(tmp_path / "walk", scene())
    lines = (path / "odometry.csv").read_bytes().split(b"\n")
    written(path / "odometry.csv", b"\n".join([*lines[:2], change, *lines[2:]]))
    assert "odometry.csv" in refused(path)


def test_a_message_of_three_bytes(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from bag_recordings import CAMERA_TOPICS, Recorder, aligned
    from recordings import scene

    class Short:
        __msgtype__ = "sensor_msgs/msg/Image"

    recorder = aligned(Recorder(), scene())
    serialise = recorder.store.serialize_cdr
    recorder.store.serialize_cdr = lambda m, kind: b"\0\1\0" if isinstance(m, Short) else serialise(m, kind)  # type: ignore[method-assign]
    recorder.add(CAMERA_TOPICS[0], 2000.0, Short())
    assert "message of 3 bytes" in refused(recorder.write(tmp_path / "walk", "mcap"))


@pytest.mark.parametrize(
    "text",
    ["[]", "null", "3", DEEP, '{"tracking": 5}', '{"seed": "x"}', '{"input": {"width": []}}'],
    ids=["array", "null", "number", "deep", "section", "seed", "width"],
)
def test_settings_of_a_run(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        Config.load(written(tmp_path / "config.json", text))


@pytest.mark.parametrize(
    "line",
    ["[]", "null", '{"index": "x"}', '{"index": 0, "timestamp_s": "x"}', '{"timestamp_s": 1e400}', '{"seconds": []}'],
)
def test_logs_of_a_run(line: str, tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", submaps=True)
    written(run.path / "log.jsonl", line + "\n")
    with pytest.raises(RunError, match=r"log\.jsonl:1"):
        run.read_log()


def test_a_log_without_times_has_no_path(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", submaps=True)
    written(run.path / "log.jsonl", '{"index": 0}\n')
    with pytest.raises(RunError, match="timestamp_s"):
        run.read_frames()


@pytest.mark.parametrize("tensors", [
    {"T_world_camera": torch.zeros(2, 3, 3)},
    {"T_world_camera": torch.full((2, 4, 4), torch.nan)},
    {"timestamps_s": torch.zeros(3), "T_world_camera": torch.zeros(2, 4, 4)},
    {"keyframes": torch.zeros(2)},
], ids=["shape", "nan", "lengths", "type"])  # fmt: skip
def test_checkpoints_of_a_run(tensors: dict[str, torch.Tensor], tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run", BASE, "walls")
    save_file(tensors, run.path / "checkpoint.safetensors")
    with pytest.raises(RunError, match=r"checkpoint\.safetensors"):
        run.read_checkpoint()
    run.write_checkpoint({"other": torch.zeros(1)}, {})
    with pytest.raises(RunError, match="params"):
        _ = run.read_checkpoint()[0]["params"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_that_may_not_be_read(tmp_path: Path) -> None:
    path = tum(tmp_path)
    (path / "rgb").chmod(0)
    assert "rgb" in refused(path)
    path.chmod(0)
    assert str(path) in refused(path)


def test_a_path_that_is_too_long_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["inspect", "a" * 5000], ["run", "x" * 300]):
        with pytest.raises(SystemExit) as left:
            cli.main(arguments)
        said = capsys.readouterr().err
        assert left.value.code == 2 and said.startswith("sigmasplat: ") and said.count("\n") == 1


def test_a_closed_standard_output_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "sigmasplat.cli", "--help"]
    ended = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert ended.stderr == "" and ended.returncode in (0, 141)
