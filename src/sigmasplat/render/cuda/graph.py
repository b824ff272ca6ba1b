"""Record what is launched on a CUDA device once, and launch it again as a whole: CUDA graphs, through torch.

What is recorded may not wait for the device or read from it, and must find its inputs where they were: it sees the same
addresses each time.
"""

import warnings
from collections.abc import Callable
from functools import cache

import torch

from sigmasplat.errors import BackendError
from sigmasplat.render.cuda.stages import measured

Work = Callable[[], None]


def repeatable(work: Work, device: torch.device) -> Work:
    """Return a function that repeats some work: a graph of it that has not run yet, or the work itself where graphs are
    not available or stages are measured, whose events a graph would not contain.

    If recording fails, one warning says why, and no more graphs are recorded on that device.
    """
    return work if device.type != "cuda" or measured() else _recorder(device).record(work)


class Recorder:
    """Records on one device, on a stream of its own. All graphs share their memory: only the last one may be run."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._last: torch.cuda.CUDAGraph | None = None
        self._refused = False

    def record(self, work: Work) -> Work:
        """Return what runs a graph of some work on the current stream, or the work itself."""
        if self._refused:
            return work
        try:
            return self._recorded(work).replay
        except (RuntimeError, BackendError) as problem:
            self._refused = True
            reason = str(problem).partition("\n")[0]
            warnings.warn(f"CUDA graphs cannot be used ({reason}); kernels are launched one by one", stacklevel=3)
            return work

    def _recorded(self, work: Work) -> torch.cuda.CUDAGraph:
        graph, pool = torch.cuda.CUDAGraph(), None if self._last is None else self._last.pool()
        # torch.cuda.graph would wait for the device and give all cached memory back first, for every fit. Another
        # thread, a viewer's, may meanwhile do what a recording thread may not.
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        self._last = graph  # its predecessor had to live until here: a pool without a graph is no more
        return graph


_recorder = cache(Recorder)
