"""Compute items ahead of their consumer, in one background thread."""

import queue
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from sigmasplat.native.threads import yield_to_others

Item = TypeVar("Item")


@dataclass(frozen=True)
class _Result(Generic[Item]):
    """One item, or the exception that ended the producer, or neither at the end."""

    item: Item | None = None
    error: BaseException | None = None
    last: bool = False


def read_ahead(items: Iterable[Item], length: int = 4) -> Iterator[Item]:
    """Yield `items` in order while a thread computes up to `length` of them in advance.

    Decoding an image takes 10 to 50 ms and releases the interpreter lock, so it runs beside tracking, and yields to it.
    An exception of the producer is raised here in place of the item. The thread ends after the last item,
    or as soon as the consumer closes or deletes this generator.
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
        _drain(results)  # frees space, so that a producer blocked in put() wakes up and sees `stop`
        thread.join()


def _produce(items: Iterable[Item], results: "queue.Queue[_Result[Item]]", stop: threading.Event) -> None:
    yield_to_others()
    try:
        for item in items:
            if stop.is_set():
                return
            results.put(_Result(item=item))
            if stop.is_set():
                return
    except BaseException as error:  # passed to the consumer's thread, which raises it
        results.put(_Result(error=error, last=True))
    else:
        results.put(_Result(last=True))


def _drain(results: "queue.Queue[_Result[Item]]") -> None:
    while True:
        try:
            results.get_nowait()
        except queue.Empty:
            return
