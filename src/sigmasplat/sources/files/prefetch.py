"""Produce items one step ahead of their consumer, in one background thread."""

import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(frozen=True)
class _Result(Generic[Item]):
    """One produced item, or the exception that ended production, or neither at the end."""

    item: Item | None = None
    error: BaseException | None = None
    last: bool = False


def read_ahead(items: Iterable[Item], length: int = 4) -> Iterator[Item]:
    """Yield `items` in order while a thread computes up to `length` of them in advance.

    Decoding an image costs ~50 ms and leaves the interpreter lock, so it hides behind the tracking of the frame before.
    An exception of the producer is raised here at the place of the item it replaces. The thread ends with the items,
    or as soon as the consumer closes or drops this generator.
    """
    results: queue.Queue[_Result[Item]] = queue.Queue(maxsize=length)
    stop = threading.Event()
    thread = threading.Thread(target=_produce, args=(items, results, stop), name="read-ahead", daemon=True)
    thread.start()
    try:
        while not (result := results.get()).last:
            yield result.item  # type: ignore[misc]
        if result.error is not None:
            raise result.error
    finally:
        stop.set()
        _drain(results)  # makes room, so a producer blocked in put() wakes, sees `stop` and ends
        thread.join()


def _produce(items: Iterable[Item], results: "queue.Queue[_Result[Item]]", stop: threading.Event) -> None:
    try:
        for item in items:
            if stop.is_set():
                return
            results.put(_Result(item=item))
            if stop.is_set():
                return
    except BaseException as error:  # handed to the consumer's thread, which raises it
        results.put(_Result(error=error, last=True))
    else:
        results.put(_Result(last=True))


def _drain(results: "queue.Queue[_Result[Item]]") -> None:
    while True:
        try:
            results.get_nowait()
        except queue.Empty:
            return
