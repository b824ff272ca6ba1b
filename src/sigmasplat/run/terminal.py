"""Show a run on a terminal, or as plain lines where there is none."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from rich.console import Console
from rich.filesize import decimal
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress as Bars,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from sigmasplat.report.summary import format_ranges
from sigmasplat.report.tables import headline, number
from sigmasplat.run.profile import shares
from sigmasplat.run.protocols import LoopResult, StepResult
from sigmasplat.types import Progress

PLAIN_LINES_EVERY_S = 10.0
Show = Callable[[int, int | None, str], None]
"""Shows how much is done, of how many (None: as said at the beginning), and a text."""
Begin = Callable[[str, int | None], Show]
"""Begins to count something, of how many (None: not known yet)."""


class Screen:
    """Write to standard output; warnings to standard error."""

    def __init__(self, out: Console | None = None, err: Console | None = None) -> None:
        self.out = out or _console(stderr=False)
        self.err = err or _console(stderr=True)

    def say(self, line: str) -> None:
        """Print a line."""
        self.out.print(line)

    def warn(self, line: str) -> None:
        """Print a warning line."""
        self.err.print(f"warning: {line}")

    @contextmanager
    def steps(self, total: int | None, done: int = 0) -> Iterator["_StepShow"]:
        """Show a session, total None where its length is not known: a bar with frames/s, splats and lost frames; a line
        where tracking is lost or a loop closed; a bar for the final map."""
        with self._counters() as begin:
            yield _StepShow(self.say, begin, total, done)

    @contextmanager
    def counting(self, title: str) -> Iterator[Progress]:
        """Show a count (done, total)."""
        with self._counters() as begin:
            show = begin(title, None)
            show(0, None, "")
            yield lambda done, total: show(done, total, "")

    @contextmanager
    def transfers(self) -> Iterator[Callable[[str, int, int], None]]:
        """Show what is copied, a bar each: (title, bytes done, bytes in all; 0 where not known)."""
        shows: dict[str, Show] = {}
        with self._counters(of_bytes=True) as begin:

            def show(title: str, done: int, total: int) -> None:
                if title not in shows:
                    shows[title] = begin(title, total or None)
                shows[title](done, total or None, "")

            yield show

    @contextmanager
    def _counters(self, of_bytes: bool = False) -> Iterator[Begin]:
        if not self.out.is_terminal:
            yield partial(_PlainShow, self.say, decimal if of_bytes else str)
            return
        count = DownloadColumn() if of_bytes else MofNCompleteColumn()
        columns = ("{task.description}", BarColumn(), count, TextColumn("{task.fields[text]}"))
        with Bars(*columns, TimeRemainingColumn(), console=self.out) as bars:
            yield partial(_bar, bars)

    def results(self, metrics: dict[str, Any]) -> None:
        """Print the figures of first interest as a table, and plainly where tracking was lost."""
        table = Table("", "value", "")
        table.columns[1].justify = "right"
        for name, value, unit in _figures(metrics):
            table.add_row(name, value, unit)
        self.out.print(table)
        lost = metrics.get("lost_frames") or []
        if lost:
            frames = metrics.get("frames")
            where = format_ranges(lost)
            self.say(f"tracking was LOST on {len(lost)} of {frames} frames: {where}; do not trust those poses")

    def profile(self, seconds: Mapping[str, float]) -> None:
        """Print where the time went, a stage a line."""
        table = Table("stage", "seconds", "share")
        for column in table.columns[1:]:
            column.justify = "right"
        for stage, spent, share in shares(seconds):
            table.add_row(stage, f"{spent:.2f}", f"{share:.1%}")
        self.out.print(table)


def _console(stderr: bool) -> Console:
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False, soft_wrap=True)


def _figures(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the report's headline with the training views' PSNR after that of the held-out ones."""
    rows = headline(metrics)
    kinds = {"PSNR, training": metrics.get("training") or {}}
    if metrics.get("training_submaps"):
        kinds["PSNR, training, in submaps"] = metrics["training_submaps"]
    training = [(name, number(scores.get("psnr_db"), 2), "dB") for name, scores in kinds.items()]
    place = 1 + max(i for i, row in enumerate(rows) if row[0].startswith("PSNR"))
    return [*rows[:place], *training, *rows[place:]]


def _bar(bars: Bars, title: str, total: int | None) -> Show:
    """Add a bar to those shown."""
    task = bars.add_task(title, total=total, text="")
    return lambda done, known, text: bars.update(task, completed=done, total=known or total, text=text)


class _StepShow:
    """Turn steps into text for a bar, and losses and loops into lines."""

    def __init__(self, say: Callable[[str], None], begin: Begin, total: int | None, done: int = 0) -> None:
        self.say, self.begin, self.show = say, begin, begin("SLAM", total)
        self.show_final: Show | None = None
        self.started_s = time.perf_counter()
        self.done, self.lost, self.before = done, 0, done
        self.lost_since: int | None = None

    def __call__(self, step: StepResult) -> None:
        self.done += 1
        self.lost += step.lost
        self._tell_losses(step)
        self._tell_loops(f"frame {step.index}", step.loops)
        speed = (self.done - self.before) / max(time.perf_counter() - self.started_s, 1e-9)
        self.show(self.done, None, f"{speed:.1f} frames/s  {step.splats:,} splats  {self.lost} lost")

    def finishing(self, done: int, total: int) -> None:
        """Show how far the final map is."""
        self.show_final = self.show_final or self.begin("final map", total)
        self.show_final(done, total, "")

    def last_loops(self, loops: Sequence[LoopResult]) -> None:
        """Tell the loops closed after the last frame."""
        self._tell_loops("at the end", loops)

    def _tell_loops(self, when: str, loops: Sequence[LoopResult]) -> None:
        for loop in loops:
            if loop.accepted:
                figures = f"residual {loop.residual:.3f}, moved {100.0 * loop.translation_m:.1f} cm"
                self.say(f"{when}: loop closed between submaps {loop.query} and {loop.database} ({figures})")

    def _tell_losses(self, step: StepResult) -> None:
        where = f"frame {step.index} (t = {step.timestamp_s:.3f} s)"
        if step.lost and self.lost_since is None:
            self.lost_since = step.index
            self.say(f"{where}: tracking lost")
        elif not step.lost and self.lost_since is not None:
            self.say(f"{where}: tracking found again, lost since frame {self.lost_since}")
            self.lost_since = None


class _PlainShow:
    """Print a line where nothing is done yet, now and then, and at the end."""

    def __init__(
        self, say: Callable[[str], None], written: Callable[[int], str], title: str, total: int | None
    ) -> None:
        self.say, self.written, self.title, self.total = say, written, title, total
        self.last_s, self.last_line = time.perf_counter(), ""

    def __call__(self, done: int, known: int | None, text: str) -> None:
        total = known or self.total
        now_s = time.perf_counter()
        if done in (0, total) or now_s - self.last_s >= PLAIN_LINES_EVERY_S:
            whole = "?" if total is None else self.written(total)
            line = f"{self.title} {self.written(done)}/{whole}  {text}".rstrip()
            line = f"{self.title} …" if done == 0 and total is None else line
            if line != self.last_line:
                self.say(line)
            self.last_s, self.last_line = now_s, line
