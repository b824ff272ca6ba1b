"""Make runs on the workers of a Dask cluster, each in a process of its own.

If a worker sees the folder of the batch, it makes the run there, and another worker can resume it. Otherwise it makes
the run in a temporary folder and sends the files back, without submaps/.
"""

import importlib
import io
import os
import secrets
import shutil
import socket
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sigmasplat.api import ConfigError, RunError, install_extra, write_text
from sigmasplat.plugins.batch.executor import DataRoots, Outcome, RunProcesses, Sequences, sequences_of
from sigmasplat.plugins.batch.job import Job, installed_code

POLL_S = 1.0
"""Time between two looks at the list of workers."""
REJOIN_S = 60.0
"""A sequence is missing if for this time no worker has it."""
DEATHS = 4
"""A run whose worker dies this many times is given up: the workers may not have enough memory for it."""


@dataclass(frozen=True)
class Worker:
    """A worker: its name, and the names of the jobs whose sequence it has."""

    name: str
    jobs: frozenset[str]


class Dispatch:
    """Makes runs on workers that come and go.

    workers: the known workers by address; new ones are added. look: returns the workers at some addresses, without
    those that do not answer. submit: starts a job on the worker at an address and returns its future. fetch: returns
    why a job failed, None if it did not; raises TimeoutError if the result is lost. say: prints a line.
    """

    def __init__(
        self,
        client: Any,
        workers: Mapping[str, Worker],
        look: Callable[[Sequence[str]], Mapping[str, Worker]],
        submit: Callable[[Job, str], Any],
        fetch: Callable[[Any, Job], str | None],
        say: Callable[[str], None],
    ) -> None:
        self.client, self.workers = client, dict(workers)
        self.look, self.submit, self.fetch, self.say = look, submit, fetch, say
        self.waiting = list[Job]()
        self.running = dict[Any, tuple[Job, str]]()
        self.deaths = dict[str, int]()
        self.without_since_s = dict[tuple[str, ...], float]()
        self.empty = False
        self.changed = threading.Event()

    def make(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Make the runs; yield each job when it ends. Raises RunError if the scheduler no longer answers."""
        self.waiting = list(jobs)
        try:
            while self.waiting or self.running:
                threads = self._threads()
                self.workers |= self.look([address for address in threads if address not in self.workers])
                yield from self._left_by_dead(threads)
                yield from self._without_worker(threads)
                self._hand_out(threads)
                yield from self._ended()
        finally:
            self.client.cancel(list(self.running), force=True)

    def _threads(self) -> dict[str, int]:
        """Return the number of threads of each worker, by its address."""
        try:
            return dict(self.client.nthreads())
        except (OSError, TimeoutError) as problem:
            raise RunError("the Dask scheduler no longer answers; start it again and repeat the command") from problem

    def _left_by_dead(self, threads: Mapping[str, int]) -> Iterator[Outcome]:
        """Take back the runs of workers that have left."""
        for future, (job, address) in list(self.running.items()):
            if address in threads or future.done():
                continue
            self.client.cancel([future], force=True)
            del self.running[future]
            self.deaths[job.name] = self.deaths.get(job.name, 0) + 1
            if self.deaths[job.name] < DEATHS:
                self.waiting.insert(0, job)
            else:
                yield Outcome(job, f"its worker died {DEATHS} times; is there enough memory?")

    def _without_worker(self, threads: Mapping[str, int]) -> Iterator[Outcome]:
        """Print which sequences no worker has any more, and give their runs up after `REJOIN_S`."""
        if not threads:
            if not self.empty:
                self.say("no worker is left; waiting for a worker")
            self.empty = True
            self.without_since_s.clear()
            return
        self.empty = False
        without = [
            job for job in self.waiting if not any(job.name in self.workers[a].jobs for a in self._known(threads))
        ]
        for paths in set(self.without_since_s) - {job.paths for job in without}:
            del self.without_since_s[paths]
        for job in without:
            had = sorted({worker.name for worker in self.workers.values() if job.name in worker.jobs})
            scene, names = job.paths[0], " and worker ".join(had)
            if job.paths not in self.without_since_s:
                self.without_since_s[job.paths] = time.monotonic()
                self.say(
                    f"{scene}: worker {names} had it and left; waiting {REJOIN_S:.0f} s for another worker that has it"
                )
            elif time.monotonic() - self.without_since_s[job.paths] > REJOIN_S:
                self.waiting.remove(job)
                yield Outcome(job, f"{scene}: worker {names} had it and left", missing=True)

    def _hand_out(self, threads: Mapping[str, int]) -> None:
        """Give each free thread a run, one worker after the other."""
        busy = [address for _, address in self.running.values()]
        free = {address: threads[address] - busy.count(address) for address in self._known(threads)}
        given = True
        while given:
            given = False
            for address in free:
                job = next((job for job in self.waiting if job.name in self.workers[address].jobs), None)
                if job and free[address] > 0:
                    self.waiting.remove(job)
                    future = self.submit(job, address)
                    future.add_done_callback(lambda _: self.changed.set())
                    self.running[future] = job, address
                    free[address] -= 1
                    given = True

    def _known(self, threads: Mapping[str, int]) -> list[str]:
        return [address for address in threads if address in self.workers]

    def _ended(self) -> Iterator[Outcome]:
        """Wait until a run ends, at most `POLL_S`; yield the runs that have ended."""
        self.changed.wait(POLL_S)
        self.changed.clear()
        for future in [future for future in self.running if future.done()]:
            job, _ = self.running.pop(future)
            try:
                yield Outcome(job, self.fetch(future, job))
            except TimeoutError:  # the worker left with the result
                self.waiting.insert(0, job)


TOKEN = ".batch"
"""File in the folder of the batch with a random text: a worker that reads the same text sees the same folder."""
CONNECT_S = 10
FETCH_S = 600.0
"""Time for the files of a run to arrive."""
LEFT_OUT = ("submaps", "state.safetensors")
"""Parts of a run folder that are not sent: they are large, and the scores need them on the worker only."""


class ClusterExecutor:
    """Makes runs on the workers of the scheduler at `address`, one at a time on each thread of a worker."""

    def __init__(self, address: str, data: DataRoots, save_every_s: float, say: Callable[[str], None]) -> None:
        """Connect, and wait for the first worker. Raises ConfigError if Dask is missing or no scheduler answers."""
        self.data, self.save_every_s = data, save_every_s
        distributed = _distributed()
        try:
            self.client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as problem:
            raise ConfigError(
                f"no Dask scheduler answers at {address} within {CONNECT_S} s; start one with: dask scheduler"
            ) from problem
        if not self.client.nthreads():
            say(f"waiting for the first worker of {address}")
        self.client.wait_for_workers(1)
        self.say, self.workers = say, dict[str, Worker]()

    @property
    def slots(self) -> int:
        """Return the number of runs that are made at the same time: the threads of all workers."""
        threads: Mapping[str, int] = self.client.nthreads()
        return max(1, sum(threads.values()))

    def survey(self, jobs: Sequence[Job]) -> Mapping[str, Sequences]:
        """Return the sequences of each worker. Raises RunError if a worker has other code."""
        try:
            found = self.client.run(_survey, [job.to_json() for job in jobs], self.data)
        except ImportError as problem:
            raise RunError(f"a worker cannot import SigmaSplat: {problem}; install the same release there") from problem
        for address, (code, *_) in found.items():
            if code != installed_code():
                raise RunError(f"the worker at {address} has other code than this machine; install the same release")
        self.workers = {address: Worker(name, frozenset(s.frames)) for address, (_, name, s) in found.items()}
        return {address: sequences for address, (*_, sequences) in found.items()}

    def make(self, jobs: Sequence[Job], out: Path) -> Iterator[Outcome]:
        """Make the runs. The runs of a worker that dies are made by another one that has their sequence."""
        token = secrets.token_hex(16)
        out.mkdir(parents=True, exist_ok=True)
        write_text(out / TOKEN, token)

        def submit(job: Job, address: str) -> Any:
            return self.client.submit(
                _make, job.to_json(), str(out.resolve()), token, self.data, installed_code(), self.save_every_s,
                key=f"{job.name}-{secrets.token_hex(16)}", workers=[address], pure=False,
            )  # fmt: skip

        def look(addresses: Sequence[str]) -> Mapping[str, Worker]:
            return self._joined(jobs, addresses)

        def fetch(future: Any, job: Job) -> str | None:
            return self._fetched(future, job, out)

        try:
            yield from Dispatch(self.client, self.workers, look, submit, fetch, self.say).make(jobs)
        finally:
            (out / TOKEN).unlink(missing_ok=True)

    def _joined(self, jobs: Sequence[Job], addresses: Sequence[str]) -> dict[str, Worker]:
        """Return the workers at some addresses; one that cannot make runs is a line and has no sequences."""
        if not addresses:
            return {}
        texts = [job.to_json() for job in jobs]
        found = self.client.run(_survey, texts, self.data, workers=list(addresses), on_error="return")
        joined = dict[str, Worker]()
        for address, answer in found.items():
            if isinstance(answer, OSError):
                continue  # it has left again
            if isinstance(answer, Exception) or answer[0] != installed_code():
                why = repr(answer) if isinstance(answer, Exception) else "it has other code"
                self.say(f"the worker at {address} gets no runs: {why}; install the same release")
                joined[address] = Worker(address, frozenset())
            else:
                joined[address] = Worker(answer[1], frozenset(answer[2].frames))
        return joined

    def _fetched(self, future: Any, job: Job, out: Path) -> str | None:
        """Return why a run failed, None if it is finished; write the files that its worker sent.

        Raises TimeoutError if the worker left with the result.
        """
        if future.status != "finished":
            problem = future.exception() if future.status == "error" else None
            return f"the worker failed: {problem!r}" if problem else "the scheduler cancelled the run"
        why, files = future.result(timeout=FETCH_S)
        if files is not None:
            unpack(files, out / job.name)
        return str(why) if why else None


def _distributed() -> Any:
    """Import Dask's scheduler client. Raises ConfigError with the command that installs it."""
    try:
        return importlib.import_module("distributed")
    except ImportError as problem:
        raise ConfigError(f"--scheduler needs the package distributed: {install_extra('cluster')}") from problem


def _survey(jobs: Sequence[str], data: DataRoots, dask_worker: Any = None) -> tuple[str, str, Sequences]:
    """Return this worker's code, name and sequences. Dask fills in `dask_worker`."""
    return (
        installed_code(),
        str(dask_worker.name),
        sequences_of([Job.from_json(text) for text in jobs], _root(data, dask_worker)),
    )


def _root(data: DataRoots, worker: Any) -> str | None:
    return data.of(str(worker.name), socket.gethostname())


def _make(
    text: str, out: str, token: str, data: DataRoots, code: str, save_every_s: float
) -> tuple[str | None, bytes | None]:
    """Make a run on this worker; return why it failed, if so, and its files, if this worker does not see `out`."""
    if code != installed_code():
        return "the worker has other code than the machine that started the batch; install the same release", None
    job, root = Job.from_json(text), _root(data, _distributed().get_worker())
    processes = RunProcesses(save_every_s)
    if _sees(Path(out), token):
        return processes.make(job, Path(out) / job.name, root), None
    with tempfile.TemporaryDirectory(prefix="sigmasplat-batch-") as temporary:
        folder = Path(temporary) / job.name
        why = processes.make(job, folder, root)
        return why, None if why else pack(folder)


def _sees(out: Path, token: str) -> bool:
    try:
        return (out / TOKEN).read_text(encoding="utf-8") == token
    except OSError:
        return False


def pack(folder: Path) -> bytes:
    """Return the files of a run folder, without its submaps, as one archive."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.relative_to(folder).parts[0] not in LEFT_OUT:
                packed.write(path, path.relative_to(folder))
    return archive.getvalue()


def unpack(files: bytes, folder: Path) -> None:
    """Write a packed run folder; an earlier one is replaced."""
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as temporary:
        zipfile.ZipFile(io.BytesIO(files)).extractall(Path(temporary) / "run")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(Path(temporary) / "run", folder)
