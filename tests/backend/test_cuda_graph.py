"""Record and run again, torch's graphs played by stand-ins: what is asked of them, and what happens when they fail."""

from contextlib import nullcontext
from typing import Any, ClassVar

import pytest
import torch

from sigmasplat.errors import BackendError
from sigmasplat.plugins.cuda.descent import Recorder, repeatable


class Graph:
    """Plays torch.cuda.CUDAGraph: says what was asked, and fails where it is told to."""

    asked: ClassVar[list[tuple[str, Any]]] = []
    fails = ""

    def capture_begin(self, pool: Any = None, capture_error_mode: str = "global") -> None:
        Graph.asked.append(("begin", pool))
        if Graph.fails == "begin":
            raise RuntimeError("CUDA error: operation not permitted\nCUDA kernel errors might be reported elsewhere")

    def capture_end(self) -> None:
        Graph.asked.append(("end", None))

    def pool(self) -> str:
        return "pool"

    def replay(self) -> None:
        Graph.asked.append(("replay", None))


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    Graph.asked, Graph.fails = [], ""
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: device)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    return Recorder(torch.device("cuda", 0))


def test_work_is_recorded_once_and_run_again(recorder: Recorder) -> None:
    """The second graph shares the memory of the first, which lives until it is recorded."""
    done: list[int] = []
    again = recorder.record(lambda: done.append(1))
    assert done == [1]
    again()
    again()
    assert done == [1] and Graph.asked == [("begin", None), ("end", None), ("replay", None), ("replay", None)]
    recorder.record(lambda: done.append(2))
    assert done == [1, 2] and Graph.asked[4:] == [("begin", "pool"), ("end", None)]


def test_where_there_are_no_graphs_one_warning_says_so(recorder: Recorder) -> None:
    Graph.fails = "begin"
    done: list[int] = []
    with pytest.warns(
        UserWarning, match=r"CUDA graphs cannot be used \(CUDA error: operation not permitted\); kernels"
    ) as seen:
        again = recorder.record(lambda: done.append(1))
    assert done == [] and len(seen) == 1
    again()
    assert done == [1]
    assert recorder.record(again) is again and Graph.asked == [("begin", None)], "it is not tried again"


@pytest.mark.parametrize("problem", [BackendError("the CUDA kernel blend cannot be launched"), RuntimeError("waits")])
def test_work_that_cannot_be_recorded_is_done_as_it_is(recorder: Recorder, problem: Exception) -> None:
    calls: list[int] = []

    def work() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise problem

    with pytest.warns(UserWarning, match="CUDA graphs cannot be used"):
        again = recorder.record(work)
    assert Graph.asked == [("begin", None), ("end", None)], "the stream is left as it was"
    again()
    assert calls == [1, 1]


def test_the_processor_has_no_graphs() -> None:
    def work() -> None: ...

    assert repeatable(work, torch.device("cpu")) is work
