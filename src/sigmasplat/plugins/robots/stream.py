"""Stream messages to Foxglove and other viewers over a WebSocket, with Foxglove's protocol.

Protocol: https://docs.foxglove.dev/docs/sdk/websocket-server, https://github.com/foxglove/ws-protocol. Foxglove's SDK
is not used: it answers any page in the browser, because it does not check the header Origin. A test compares the
messages with those of the SDK.

Nothing that a client sends reaches the run: only `subscribe` and `unsubscribe` are read. A client that reads too slowly
misses messages.
"""

import asyncio
import contextlib
import json
import logging
import socket
import struct
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

from sigmasplat.api import ConfigError, SigmaSplatError, import_optional
from sigmasplat.plugins.robots.ros_messages import TOPICS, Encoded, RosMessages, Topic
from sigmasplat.plugins.viewer.server import is_loopback, page_of

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

EXTRA = "foxglove"
HOST, PORT = "127.0.0.1", 8765
SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
WEB_APP = "app.foxglove.dev"
MOST_WAITING_BYTES = 8_000_000
"""While more than this waits for a client, it gets no further message."""
SEND_BUFFER_BYTES = 262_144
"""Size of the system's own queue in front of a client. By default it grows to megabytes, all of them out of date."""
MOST_CLIENTS = 16
MOST_REQUESTS = 1000
"""A client that sends more requests is disconnected."""
MOST_REQUEST_BYTES = 65536
"""A longer message from a client closes its connection."""
CLOSE_S = 2.0
"""At the end, clients have this many seconds to receive what waits."""
MESSAGE_DATA = struct.Struct("<BIQ")
"""Operation code 1, subscription, time in nanoseconds; then the message."""


def is_allowed_origin(origin: str | None) -> bool:
    """Return whether a request with this header Origin may read the stream.

    Allowed are programs that are not browsers (no Origin, or a scheme of their own, as desktop applications have),
    pages of this machine, and Foxglove's web application. Any other page in the browser is refused.
    """
    if origin is None:
        return True
    scheme, _, name = page_of(origin)
    if scheme not in ("http", "https"):
        return bool(scheme)  # "null" has no scheme: a page in a sandbox
    return is_loopback(name) or (name == WEB_APP and scheme == "https")


def check_stream(port: int) -> None:
    """Raise ConfigError if the port is out of range, SourceError if the packages of the extra are missing."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--stream must be a port from 0 to 65535, found {port}")
    for module in ("websockets.asyncio.server", "rosbags.typesys"):
        import_optional(module, EXTRA, "--stream")


class StreamSink:
    """A WebSocket server on a thread of its own.

    port, url: where it listens; missed: number of messages that slow clients did not get.
    """

    name = "stream"

    def __init__(self, messages: RosMessages, host: str = HOST, port: int = PORT) -> None:
        """Start to listen; port 0 means any free port.

        Raises SigmaSplatError if a package is missing or the port is not free, ConfigError if it is out of range.
        """
        check_stream(port)
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # do not log clients that disconnect
        self.host, self.missed = host, 0
        self._clients = dict["ServerConnection", dict[int, Topic]]()  # topics by subscription; used on the loop only
        self._last = dict[str, Encoded]()
        self._wanted = frozenset[str]()
        channels = [
            {
                "id": number, "topic": topic.name, "encoding": "cdr", "schemaName": topic.msgtype,
                "schemaEncoding": "ros2msg", "schema": messages.schema(topic),
            }
            for number, topic in enumerate(TOPICS, 1)
        ]  # fmt: skip
        self._advertisement = json.dumps({"op": "advertise", "channels": channels})
        started = Future[tuple[asyncio.AbstractEventLoop, asyncio.Event, int]]()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._run(port, started)), name="sigmasplat-websocket", daemon=True
        )
        self._thread.start()
        try:
            self._loop, self._stop, self.port = started.result()
        except OSError as problem:
            raise SigmaSplatError(
                f"cannot stream on {host}:{port} ({problem.strerror or problem}); give another port: --stream PORT"
            ) from problem
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self.port}"

    def open(self, messages: RosMessages) -> None:
        """Do nothing: the server listens already."""

    def wants(self, *topics: Topic) -> bool:
        """Return whether a client subscribes to one of these topics, or a later client would get its last message."""
        return any(topic.latched or topic.name in self._wanted for topic in topics)

    def write(self, message: Encoded) -> None:
        """Send a message to its subscribers."""
        self._loop.call_soon_threadsafe(self._publish, message)

    def close(self) -> None:
        """Give clients a moment to receive what waits, then disconnect them."""
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(2 * CLOSE_S)

    abort = close

    # ---- on the loop ----

    async def _run(self, port: int, started: "Future[tuple[asyncio.AbstractEventLoop, asyncio.Event, int]]") -> None:
        """Serve until `_stop` is set; report loop, event and port, or why the port cannot be used."""
        from websockets.asyncio.server import serve

        try:
            server = await serve(
                self._serve, self.host, port, process_request=self._answer, select_subprotocol=self._subprotocol,
                compression=None, max_size=MOST_REQUEST_BYTES, max_queue=4, open_timeout=5.0, close_timeout=CLOSE_S,
            )  # fmt: skip
        except Exception as problem:
            return started.set_exception(problem)
        stop = asyncio.Event()
        started.set_result((asyncio.get_running_loop(), stop, int(next(iter(server.sockets)).getsockname()[1])))
        await stop.wait()
        server.close()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(server.wait_closed(), 1.5 * CLOSE_S)

    def _answer(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        if not is_allowed_origin(request.headers.get("Origin")):
            return connection.respond(403, "this page may not read the stream\n")
        if len(self._clients) >= MOST_CLIENTS:
            return connection.respond(503, f"{MOST_CLIENTS} clients are connected already\n")
        return None

    def _subprotocol(self, connection: "ServerConnection", offered: Any) -> Any:
        """Choose the newest protocol that a client offers; refuse clients that offer none."""
        from websockets.exceptions import NegotiationError

        found = next((name for name in SUBPROTOCOLS if name in offered), None)
        if found is None:
            raise NegotiationError(f"the stream speaks {SUBPROTOCOLS[0]} only")
        return found

    async def _serve(self, connection: "ServerConnection") -> None:
        from websockets.exceptions import ConnectionClosed

        connection.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        self._clients[connection] = {}
        info = {"op": "serverInfo", "name": "SigmaSplat", "capabilities": [], "metadata": {}, "sessionId": "run"}
        try:
            await connection.send(json.dumps(info))
            await connection.send(self._advertisement)
            for _ in range(MOST_REQUESTS):
                self._request(connection, await connection.recv())
        except ConnectionClosed:
            pass
        finally:
            del self._clients[connection]
            self._count_subscriptions()

    def _request(self, connection: "ServerConnection", text: str | bytes) -> None:
        """Handle a request of a client; ignore what is no valid subscription."""
        topics = self._clients[connection]
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError):
            request = json.loads(text)
            if request["op"] == "subscribe":
                for entry in request["subscriptions"][: len(TOPICS)]:
                    number, channel = entry["id"], entry["channelId"]
                    known = isinstance(number, int) and 0 <= number < 2**32 and 1 <= channel <= len(TOPICS)
                    if known and len(topics) < len(TOPICS):
                        topics[number] = TOPICS[channel - 1]
                        if topics[number].name in self._last:
                            self._send(connection, number, self._last[topics[number].name])
            elif request["op"] == "unsubscribe":
                for number in request["subscriptionIds"]:
                    topics.pop(number, None)
        self._count_subscriptions()

    def _count_subscriptions(self) -> None:
        self._wanted = frozenset(topic.name for topics in self._clients.values() for topic in topics.values())

    def _publish(self, message: Encoded) -> None:
        if message.topic.latched:
            self._last[message.topic.name] = message
        for connection, topics in self._clients.items():
            for number, topic in topics.items():
                if topic is message.topic:
                    self._send(connection, number, message)

    def _send(self, connection: "ServerConnection", subscription: int, message: Encoded) -> None:
        """Send a message without waiting, unless too much waits already."""
        from websockets.asyncio.server import broadcast

        if connection.transport.get_write_buffer_size() > MOST_WAITING_BYTES:
            self.missed += 1
        else:
            broadcast([connection], MESSAGE_DATA.pack(1, subscription, message.stamp_ns) + message.data)
