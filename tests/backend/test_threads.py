"""Threads that do not have to be on time yield to tracking, and so do the threads that help in their kernels."""

import os
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from sigmasplat.input.source import read_ahead
from sigmasplat.native.threads import NICENESS, idle_kernel_workers, set_kernel_threads, yield_to_others

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a priority for each thread")


def niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


def in_a_thread(work: Callable[[], object]) -> object:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(work()))
    thread.start()
    thread.join()
    return results[0]


def policies() -> dict[int, int]:
    """Return the scheduling policy of each thread of this process."""
    return {int(number): os.sched_getscheduler(int(number)) for number in os.listdir("/proc/self/task")}


def test_only_the_calling_thread_yields() -> None:
    before = niceness()

    def work() -> int:
        yield_to_others()
        return niceness()

    assert in_a_thread(work) == NICENESS
    assert niceness() == before < NICENESS


def test_a_sandbox_that_forbids_priorities_stops_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(which: int, who: int, priority: int) -> None:
        raise PermissionError("operation not permitted")

    monkeypatch.setattr(os, "setpriority", refuse)
    assert list(read_ahead([1, 2, 3])) == [1, 2, 3]


def test_reading_ahead_yields_to_the_consumer() -> None:
    before = niceness()

    def items() -> Iterator[int]:
        yield niceness()

    assert list(read_ahead(items())) == [NICENESS]
    assert niceness() == before


def test_threads_that_help_in_the_kernels_run_in_idle_time() -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the compiled kernels are not built")

    def work() -> tuple[set[int], int]:
        set_kernel_threads(3)
        before = policies()
        idle_kernel_workers()
        after = policies()
        return {after[number] for number in after.keys() - before.keys()}, after[threading.get_native_id()]

    helpers, caller = in_a_thread(work)  # type: ignore[misc]
    assert helpers == {os.SCHED_IDLE}
    assert caller == os.SCHED_OTHER
