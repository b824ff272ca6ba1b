"""Record kernel launches on a CUDA device once, and replay them together: CUDA graphs, through torch.

Recorded work must not wait for the device or read from it. Its inputs must stay at the same addresses, because each
replay uses the addresses of the recording.
"""

import warnings
from collections.abc import Callable
from functools import cache

import torch

from sigmasplat.api import BackendError
from sigmasplat.plugins.cuda.stages import measured

Work = Callable[[], None]


def repeatable(work: Work, device: torch.device) -> Work:
    """Return a function that repeats some work: a graph of it, which has not run yet, or the work itself.

    The work itself is returned if graphs are not available, or if stages are measured, because a graph would not
    contain the events of the measurement. If recording fails, one warning gives the reason, and no more graphs are
    recorded on that device.
    """
    return work if device.type != "cuda" or measured() else _recorder(device).record(work)


class Recorder:
    """Records on one device, on its own stream. All graphs share their memory, so only the latest one may run."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._last: torch.cuda.CUDAGraph | None = None
        self._refused = False

    def record(self, work: Work) -> Work:
        """Return a function that runs a graph of some work on the current stream, or the work itself."""
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
        # torch.cuda.graph is not used: for every fit it would first wait for the device and release all cached memory.
        # "thread_local": another thread, such as the viewer's, may meanwhile call functions that are forbidden while
        # recording.
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        self._last = graph  # the graph before must exist until here, because the pool is freed with its last graph
        return graph


_recorder = cache(Recorder)
