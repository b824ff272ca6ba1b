"""Runs that write a bag and stream: what a robot receives, and that no consumer changes the run."""

import json
import socket
import struct
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from command_line import exit_code
from ros_reading import covariance, decoded, image, links, points, pose, read_bag, seconds
from run_process import files_of_at_most
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.slam.slam import Slam
from small_room import frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
pytest.importorskip("rosbags", reason="rosbags is not installed (extra `ros`)")
pytest.importorskip("websockets", reason="websockets is not installed (extra `foxglove`)")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from sigmasplat.plugins.robots.bag import BagSink
from sigmasplat.plugins.robots.live import LiveRobot
from sigmasplat.plugins.robots.outlet import Outlet, Sink
from sigmasplat.plugins.robots.ros_messages import TOPICS, RosMessages
from sigmasplat.plugins.robots.stream import MOST_REQUEST_BYTES, SUBPROTOCOLS, StreamSink

SETTINGS = {
    "input.width": "160", "mapping.first_iterations": "40", "mapping.iterations": "10", "final.iterations": "4",
    "submaps.distance_m": "0", "submaps.uncertainty_m": "0", "submaps.frames": "10",
    "loops.min_interval": "1", "loops.min_similarity": "0.3",
    "mapping.lr_pose_translation": "2e-4", "mapping.lr_pose_rotation": "1e-4", "registration.method": "few-steps",
    "mapping.divided": "false",
}  # fmt: skip
"""Mapping moves the keyframes of this short walk, so that the loop has something to correct. The walk is too short for
a search for loops that is divided over its frames."""
FRAMES = 26
MESSAGES = RosMessages()
ROOM = "synthetic:frames=60,width=64,height=48"
TINY = ("--set", "input.width=64", "--set", "mapping.first_iterations=3", "--set", "final.iterations=0")


@cache
def there_and_back() -> list[Frame]:
    """Walk thirteen frames ahead and the same way back, so that a loop is closed."""
    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    return [replace(frame_at(i), index=n, timestamp_s=n / 30.0) for n, i in enumerate(order)]


def settings() -> Config:
    return override(preset(default_preset()), SETTINGS)


def followed(
    sinks: list[Sink], warnings: list[str] | None = None, frames: Sequence[Frame] | None = None
) -> tuple[Slam, list[Outlet]]:
    """Run with these sinks."""
    slam, outlets = Slam(settings()), [Outlet(sink, MESSAGES) for sink in sinks]
    robot = LiveRobot(slam, outlets, [].append if warnings is None else warnings.append, "all")
    for frame in there_and_back() if frames is None else frames:
        robot.watch(frame)
        robot(slam.step(frame))
    before = len(slam.loops)
    slam.finish()
    robot.last_loops(slam.loops[before:])
    robot.close()
    return slam, outlets


def turned_by_90_degrees(frames: Sequence[Frame], measured: bool) -> tuple[list[Frame], np.ndarray]:
    """Return the frames of a camera held sideways, with the force on it (3° off) if it is measured, and the vertical
    direction in the world."""
    poses, R = walk().truth().T_world_camera, np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    R_error = Rotation.from_euler("y", 3, degrees=True).as_matrix()
    turned = []
    for n, frame in enumerate(frames):
        c = frame.camera
        up = R @ poses[min(n, FRAMES - 1 - n)][2, :3]
        turned.append(
            replace(
                frame, color=np.rot90(frame.color).copy(), depth_m=np.rot90(frame.depth_m).copy(),
                camera=Camera(c.height, c.width, c.fy, c.fx, c.cy, c.width - 1 - c.cx),
                specific_force_m_s2=9.81 * R_error @ up if measured else None,
            )
        )  # fmt: skip
    return turned, R @ poses[0][2, :3]


def contents(slam: Slam) -> dict[str, bytes]:
    saved = {name: tensor.numpy().tobytes() for name, tensor in slam.checkpoint().items()}
    return saved | {"map": slam.field.params.numpy().tobytes()}


@cache
def plain() -> dict[str, bytes]:
    """Return what a run leaves behind without any consumer."""
    return contents(followed([])[0])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path, list[Outlet]]:
    folder = tmp_path_factory.mktemp("robots") / "bag"
    slam, outlets = followed([BagSink(folder)])
    return slam, folder, outlets


# ---- the bag ----


def test_a_bag_changes_nothing_in_the_run(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    slam, _, (outlet,) = recorded
    assert contents(slam) == plain()
    assert outlet.failure == "" and outlet.written > 5 * (FRAMES - outlet.dropped)


def test_a_loop_moves_map_to_odom_and_the_odometry_is_continuous(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    slam, folder, _ = recorded
    bag = read_bag(folder)
    transforms, odometry = [links(message) for message in bag["/tf"]], bag["/sigmasplat/odometry"]
    assert len(transforms) == len(odometry) == FRAMES
    static = links(bag["/tf_static"][-1])
    for T, moved, step in zip(transforms, odometry, slam.steps, strict=True):
        in_map = T["map", "odom"] @ T["odom", "camera_link"] @ static["camera_link", "camera_optical_frame"]
        np.testing.assert_allclose(in_map, static["map", "sigmasplat_world"] @ step.T_world_camera, atol=1e-6)
        np.testing.assert_allclose(pose(moved), T["odom", "camera_link"], atol=1e-9)
        assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "camera_link")
        assert seconds(moved) == pytest.approx(step.timestamp_s, abs=1e-8)
    at_loop = [i for i, step in enumerate(slam.steps) if any(loop.accepted for loop in step.loops)]
    assert at_loop, "this walk closes a loop before its end"
    corrections = [np.abs(b["map", "odom"] - a["map", "odom"]).max() for a, b in pairwise(transforms)]
    assert corrections[at_loop[0] - 1] > 1e-4, "the loop is in map → odom"
    along = np.stack([T["odom", "camera_link"] for T in transforms])
    steps_m = np.linalg.norm(np.diff(along[:, :3, 3], axis=0), axis=1)
    true = np.stack([T for T in _truth(slam)])
    true_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps_m, true_m, atol=5e-3)


def _truth(slam: Slam) -> np.ndarray:
    from small_room import walk

    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    return walk().truth().T_world_camera[order]


def test_covariances_are_known_as_documented(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    slam, folder, _ = recorded
    bag = read_bag(folder)
    first = next(i for i, step in enumerate(slam.steps) if i and step.is_keyframe)
    for i, message in enumerate(bag["/sigmasplat/odometry"]):
        C = covariance(message)
        if 0 < i < first:
            assert C[0, 0] == -1.0, "the first hop between keyframes is not known yet"
        else:
            np.testing.assert_allclose(C, C.T, atol=1e-15)
            assert np.linalg.eigvalsh(C).min() > 0 and np.sqrt(C[:3, :3].trace()) < 0.1
    loops = bag["/sigmasplat/loop_closure"]
    at_end = any(loop.accepted for loop in slam.loops if loop.query == len(slam.store) - 1)
    assert len(loops) == sum(any(loop.accepted for loop in step.loops) for step in slam.steps) + at_end
    for message in loops:
        assert message.header.frame_id == "map" and np.linalg.eigvalsh(covariance(message)).min() > 0


def test_the_final_map_is_given_as_points_and_as_a_grid(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    slam, folder, _ = recorded
    bag = read_bag(folder)
    clouds, static = bag["/sigmasplat/cloud"], links(bag["/tf_static"][-1])
    assert len(clouds) == len(slam.store), "one at each cut, and the final map"
    rows, assured = points(clouds[-1]), slam.uncertainty
    assert assured is not None and assured.std is not None
    opaque = slam.field.opacities >= 0.5
    assert len(rows) == int(opaque.sum())
    np.testing.assert_array_equal(rows["depth_std"], assured.std.depth_std_m[opaque].numpy())
    T = static["map", "sigmasplat_world"]
    expected = slam.field.means[opaque].numpy() @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(np.stack([rows[name] for name in "xyz"], 1), expected, atol=1e-4)
    (grid,), (sure,) = bag["/map"], bag["/sigmasplat/map_depth_std_cm"]
    assert grid.header.frame_id == sure.header.frame_id == "floor" and grid.data.shape == sure.data.shape
    assert set(np.unique(grid.data)) <= {-1, 0, 100} and (grid.data == 0).any() and (grid.data == 100).any()
    up = static["map", "floor"][:3, 2]
    assert up[2] > 0.7, "z of the floor is nearly that of the map, whose first camera was nearly level"


@pytest.mark.slow
@pytest.mark.parametrize("measured", [True, False])
def test_the_accelerometer_levels_the_floor_of_a_camera_held_sideways(tmp_path: Path, measured: bool) -> None:
    frames, up_world = turned_by_90_degrees(there_and_back(), measured)
    followed([BagSink(tmp_path / "bag")], frames=frames)
    static = links(read_bag(tmp_path / "bag")["/tf_static"][-1])
    T_floor_world = np.linalg.inv(static["map", "floor"]) @ static["map", "sigmasplat_world"]
    off_deg = np.rad2deg(np.arccos(T_floor_world[2, :3] @ up_world))
    assert off_deg < 1.5 if measured else off_deg > 60.0, "without it, the images alone mislead"


def test_our_own_source_reads_the_same_frames(tmp_path: Path) -> None:
    more = ("--no-eval", "--limit", "6", "--out", str(tmp_path / "run"), "--bag-images", "all")
    assert exit_code("run", ROOM, *more, "--bag", str(tmp_path / "bag"), *TINY) == 0
    source, again = open_source(ROOM), open_source(str(tmp_path / "bag"))
    facts = RunFolder(tmp_path / "run").facts()["bag"]
    assert facts["failure"] == "" and facts["written"] > 0 and len(again) == 6 and facts["dropped"] == 0
    for i in range(6):
        wanted, found = source.frame(i), again.frame(i)
        assert found.camera == wanted.camera and found.timestamp_s == pytest.approx(wanted.timestamp_s, abs=1e-8)
        np.testing.assert_array_equal(found.depth_m, wanted.depth_m)
        np.testing.assert_allclose(found.color, wanted.color, atol=0.5 / 255 + 1e-6)
    assert again.truth() is None, "the estimated path of one run is no ground truth of the next one"


def test_a_resumed_run_writes_a_bag_of_its_own_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    more = ("--no-eval", "--out", str(tmp_path / "run"), "--save-every", "0", *TINY)

    def stopped(slam: Slam, *args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Slam, "finish", stopped)
        assert exit_code("run", ROOM, "--limit", "5", *more) == 130
    facts = RunFolder(tmp_path / "run").facts()
    assert facts["status"] == "interrupted" and "bag" not in facts
    assert exit_code("resume", str(tmp_path / "run"), "--no-eval", "--bag", str(tmp_path / "bag")) == 0
    bag = read_bag(tmp_path / "bag")
    assert not bag["/tf"] and len(bag["/tf_static"]) >= 1, "all frames were done already"
    (cloud,) = bag["/sigmasplat/cloud"]
    assert seconds(cloud) == pytest.approx(RunFolder(tmp_path / "run").read_log()[-1]["timestamp_s"], abs=1e-8)


@pytest.mark.slow
def test_a_full_disk_ends_the_bag_and_not_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = "synthetic:frames=60,width=320,height=240"
    more = ("--no-eval", "--limit", "8", *TINY)
    assert exit_code("run", large, "--out", str(tmp_path / "plain"), *more) == 0
    capsys.readouterr()
    with files_of_at_most(2_000_000):  # the run's own files are smaller, the bag is larger
        bag = ("--bag", str(tmp_path / "bag"), "--bag-images", "all")
        assert exit_code("run", large, "--out", str(tmp_path / "run"), *more, *bag) == 0
    said = capsys.readouterr().err
    assert said.count("the bag ended") == 1 and said.count("\n") == 1
    one, other = RunFolder(tmp_path / "plain"), RunFolder(tmp_path / "run")
    assert other.facts()["status"] == "complete" and other.facts()["bag"]["failure"] == "File too large"
    for name in ("trajectory.txt", "map.ply", "checkpoint.safetensors"):
        assert (one.path / name).read_bytes() == (other.path / name).read_bytes()


def test_mistakes_are_one_line_and_leave_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").mkdir()
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = str(busy.getsockname()[1])
        for given in (
            ("--bag", str(tmp_path / "taken")),
            ("--bag", str(tmp_path / "bag.mcap")),
            ("--bag", str(tmp_path / "no" / "bag")),
            ("--stream", "70000"),
            ("--stream", port),
        ):
            assert exit_code("run", ROOM, "--out", str(tmp_path / "run"), "--no-eval", *TINY, *given) == 2
            assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_mcaps_own_reader_decodes_the_same(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed (make install-dev)")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    bag, seen = read_bag(recorded[1]), dict[str, list[Any]]()
    with (recorded[1] / "bag.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append(message)
    assert {topic: len(messages) for topic, messages in seen.items()} == {t: len(m) for t, m in bag.items() if m}
    for topic in ("/sigmasplat/odometry", "/sigmasplat/loop_closure"):
        for one, other in zip(seen[topic], bag[topic], strict=True):
            np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
            np.testing.assert_array_equal(pose(one), pose(other))
    for one, other in zip(seen["/tf"], bag["/tf"], strict=True):
        assert all(np.array_equal(T, links(other)[name]) for name, T in links(one).items())
    assert bytes(seen["/sigmasplat/cloud"][-1].data) == bag["/sigmasplat/cloud"][-1].data.tobytes()
    assert list(seen["/map"][0].data) == bag["/map"][0].data.tolist()


# ---- the stream ----


def client_of(stream: StreamSink, **more: Any) -> ClientConnection:
    return connect(stream.url, subprotocols=list(SUBPROTOCOLS[:1]), max_size=None, compression=None, **more)


def subscribe(client: ClientConnection) -> dict[int, dict[str, Any]]:
    """Subscribe to all channels; return them by subscription."""
    assert json.loads(client.recv(10))["op"] == "serverInfo"
    channels = json.loads(client.recv(10))["channels"]
    wanted = [{"id": 100 + channel["id"], "channelId": channel["id"]} for channel in channels]
    client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return {100 + channel["id"]: channel for channel in channels}


class Listener(threading.Thread):
    """A client that subscribes to everything and keeps what it receives."""

    def __init__(self, stream: StreamSink) -> None:
        super().__init__(daemon=True)
        self.client = client_of(stream)
        self.channels = subscribe(self.client)
        self.received = list[bytes]()
        self.start()

    def run(self) -> None:
        self.received = [message for message in self.client if isinstance(message, bytes)]

    def messages(self) -> dict[str, list[tuple[int, Any]]]:
        found: dict[str, list[tuple[int, Any]]] = {topic.name: [] for topic in TOPICS}
        for data in self.received:
            code, subscription, time_ns = struct.unpack_from("<BIQ", data)
            channel = self.channels[subscription]
            assert code == 1
            found[channel["topic"]].append((time_ns, decoded(data[13:], channel["schemaName"])))
        return found


def test_a_client_receives_what_a_bag_holds(recorded: tuple[Slam, Path, list[Outlet]]) -> None:
    stream = StreamSink(MESSAGES, port=0)
    listener = Listener(stream)
    slam, (outlet,) = followed([stream])
    listener.join(30)
    assert contents(slam) == plain() and outlet.failure == ""
    found, bag = listener.messages(), read_bag(recorded[1])
    for topic in ("/tf", "/sigmasplat/odometry"):
        assert len(found[topic]) == FRAMES
    for (time_ns, message), kept in zip(found["/tf"], bag["/tf"], strict=True):
        assert time_ns * 1e-9 == pytest.approx(seconds(kept.transforms[0]), abs=1e-8)
        for name, T in links(message).items():
            np.testing.assert_array_equal(T, links(kept)[name])
    np.testing.assert_array_equal(found["/map"][-1][1].data, bag["/map"][-1].data)
    pictures = {time_ns: image(message) for time_ns, message in found["/camera/color/image_raw"]}
    assert pictures, "images are dropped if the thread is late, but not all"
    for frame in there_and_back():
        if round(frame.timestamp_s * 1e9) in pictures:
            np.testing.assert_array_equal(pictures[round(frame.timestamp_s * 1e9)], np.rint(255 * frame.color))


def raw_client(stream: StreamSink, *lines: str) -> socket.socket:
    """Open a WebSocket by hand, with more lines in the request."""
    found = socket.socket()
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    found.settimeout(10)
    found.connect(("127.0.0.1", stream.port))
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    request = [
        "GET / HTTP/1.1",
        "Host: x",
        "Upgrade: websocket",
        "Connection: Upgrade",
        key,
        "Sec-WebSocket-Version: 13",
    ]
    found.sendall("\r\n".join([*request, f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[0]}", *lines, "", ""]).encode())
    return found


def framed(payload: bytes, code: int = 1) -> bytes:
    """Return a masked frame of a client."""
    size = bytes([0x80 | len(payload)]) if len(payload) < 126 else b"\xfe" + struct.pack(">H", len(payload))
    return bytes([0x80 | code]) + size + b"\0\0\0\0" + payload


@pytest.mark.slow
def test_malicious_and_slow_clients_change_nothing() -> None:
    stream, garbage = StreamSink(MESSAGES, port=0), np.random.default_rng(0)
    requests = [
        b"{", b"[]", b"null", b'"x"', b'{"op":"subscribe"}', b'{"op":"subscribe","subscriptions":7}',
        b'{"op":"subscribe","subscriptions":[{"id":-1,"channelId":99999}]}', b"[" * 20_000,
        b'{"op":"subscribe","subscriptions":[{"id":1e999,"channelId":1}]}',
        b'{"op":"unsubscribe","subscriptionIds":[{}]}',
        b'{"op":"subscribe","subscriptions":[{"id":true,"channelId":true}]}', b'{"op":"advertise","channels":[{}]}',
    ]  # fmt: skip
    with ExitStack() as stack:
        for _ in range(3):  # no WebSocket at all
            other = stack.enter_context(socket.create_connection(("127.0.0.1", stream.port)))
            other.sendall(garbage.bytes(5000))
        silent = stack.enter_context(socket.create_connection(("127.0.0.1", stream.port)))  # never sends anything
        hostile = stack.enter_context(raw_client(stream))
        for request in requests:
            hostile.sendall(framed(request))
            hostile.sendall(framed(request, code=2))
        broken = stack.enter_context(raw_client(stream))
        broken.sendall(garbage.bytes(3000))
        deaf = stack.enter_context(raw_client(stream))  # subscribes to images many times and never reads
        images = [number for number, topic in enumerate(TOPICS, 1) if topic.name.endswith("image_raw")]
        wanted = [{"id": i, "channelId": images[i % len(images)]} for i in range(len(TOPICS))]
        deaf.sendall(framed(json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()))
        listener = Listener(stream)
        slam, (outlet,) = followed([stream])
        listener.join(30)
        assert contents(slam) == plain()
        assert outlet.failure == "" and outlet.record()["missed"] > 0, "the client that never reads has missed messages"
        assert len(listener.messages()["/tf"]) == FRAMES, "and the client that reads has them all"
        assert silent.fileno() >= 0


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        (None, True), ("https://app.foxglove.dev", True), ("http://localhost:8080", True), ("http://127.0.0.1", True),
        ("file://", True), ("https://evil.example", False), ("http://app.foxglove.dev", False), ("null", False),
        ("https://app.foxglove.dev.evil.example", False), ("http://localhost.evil.example", False), ("http://[", False),
    ],
)  # fmt: skip
def test_only_own_pages_and_programs_may_read(origin: str | None, allowed: bool) -> None:
    stream = StreamSink(MESSAGES, port=0)
    try:
        if allowed:
            with client_of(stream, origin=origin) as client:
                assert json.loads(client.recv(10))["op"] == "serverInfo"
        else:
            with pytest.raises(InvalidStatus) as refused:
                client_of(stream, origin=origin)
            assert refused.value.response.status_code == 403
    finally:
        stream.close()


def test_the_stream_listens_on_this_machine_only_and_refuses_long_messages() -> None:
    stream = StreamSink(MESSAGES, port=0)
    try:
        assert stream.url == f"ws://127.0.0.1:{stream.port}"
        with client_of(stream) as client:
            subscribe(client)
            client.send("x" * (MOST_REQUEST_BYTES + 1))
            with pytest.raises(Exception, match="1009"):
                while True:
                    client.recv(10)
        with pytest.raises(InvalidStatus):
            connect(stream.url)  # no subprotocol
    finally:
        stream.close()


def test_a_late_client_gets_the_latched_messages() -> None:
    stream = StreamSink(MESSAGES, port=0)
    outlet = Outlet(stream, MESSAGES)
    sent = MESSAGES.transforms(TOPICS[1], 7, [("camera_link", "camera_optical_frame", np.eye(4))])
    done = threading.Event()

    def job(messages: RosMessages) -> list:
        return [sent]

    outlet.offer(job, TOPICS[1])
    outlet.offer(lambda messages: done.set() or [], TOPICS[1])
    assert done.wait(10)
    with client_of(stream) as client:
        channels = subscribe(client)
        data = client.recv(10)
        assert isinstance(data, bytes) and struct.unpack_from("<BIQ", data) == (1, 102, 7)
        assert channels[102]["topic"] == "/tf_static" and data[13:] == sent.data
    outlet.close()


def test_the_protocol_is_that_of_foxgloves_sdk() -> None:
    foxglove = pytest.importorskip("foxglove", reason="foxglove-sdk is not installed (19 MB, MIT)")
    context = foxglove.Context()
    server = foxglove.start_server(name="SigmaSplat", port=0, context=context, session_id="run")
    stream = StreamSink(MESSAGES, port=0)
    try:
        with connect(f"ws://127.0.0.1:{server.port}", subprotocols=list(SUBPROTOCOLS[:1])) as theirs:
            with client_of(stream) as ours:
                told, expected = json.loads(ours.recv(10)), json.loads(theirs.recv(10))
                assert {**expected, "metadata": {}} == told
                channels = json.loads(ours.recv(10))["channels"]
            made = [
                foxglove.Channel(
                    c["topic"], message_encoding=c["encoding"], context=context,
                    schema=foxglove.Schema(
                        name=c["schemaName"], encoding=c["schemaEncoding"], data=c["schema"].encode()
                    ),
                )
                for c in channels
            ]  # fmt: skip
            found = []
            while len(found) < len(made):
                found += json.loads(theirs.recv(10))["channels"]
            known = {c["topic"]: {k: v for k, v in c.items() if k != "id"} for c in found}
            assert known == {c["topic"]: {k: v for k, v in c.items() if k != "id"} for c in channels}
    finally:
        stream.close()
        server.stop()
