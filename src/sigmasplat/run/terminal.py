"""Show a run on a terminal, or as plain lines if the output is not a terminal."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

from rich import progress
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table

from sigmasplat.data.trajectory import APART, RELOCALISED
from sigmasplat.run.callbacks import Callback
from sigmasplat.types import Progress

if TYPE_CHECKING:
    from sigmasplat.graph.loops import Loop
    from sigmasplat.slam.results import Step

Alarms = Mapping[str, Sequence[str]]
"""What is wrong, each in one line, and the commands to try instead."""
PLAIN_LINES_EVERY_S = 10.0
Show = Callable[[int, int | None, str], None]
"""Shows (done, total, text); total None: as given at the start."""
Begin = Callable[[str, int | None], Show]
"""Starts a counter with (title, total); total None: not known yet."""


ASSUMED = "assumed, because the recording does not say it (in brackets what changes it):"
CORRECTED = "corrected, because of what the images show or say:"


class Screen:
    """Write to standard output; warnings to standard error."""

    def __init__(self, out: Console | None = None, err: Console | None = None) -> None:
        self.out = out or _console(stderr=False)
        self.err = err or _console(stderr=True)

    def say(self, line: str, style: str | None = None) -> None:
        """Print a line, on a terminal in a style of rich."""
        self.out.print(line, style=style)

    def warn(self, line: str) -> None:
        """Print a warning line."""
        self.err.print(f"warning: {line}")

    def assumptions(self, assumed: Sequence[str], corrections: Sequence[str]) -> None:
        """Print what is assumed because a recording does not say it, and how its images are corrected, in one block."""
        for title, lines in ((ASSUMED, assumed), (CORRECTED, corrections)):
            if lines:
                self.say("\n  ".join([title, *lines]))

    @contextmanager
    def steps(self, total: int | None, done: int = 0) -> Iterator["_StepShow"]:
        """Show a session of `total` frames, None if unknown.

        One bar shows frames/s, splats and lost frames, another one the final map. Lost tracking, relocalisation,
        components and closed loops are printed as lines.
        """
        with self._counters() as begin:
            yield _StepShow(self.say, begin, total, done)

    @contextmanager
    def counting(self, title: str) -> Iterator[Progress]:
        """Show a counter; the yielded function takes (done, total)."""
        with self._counters() as begin:
            show = begin(title, None)
            show(0, None, "")
            yield lambda done, total: show(done, total, "")

    @contextmanager
    def transfers(self) -> Iterator[Callable[[str, int, int], None]]:
        """Show a bar per file transfer; the yielded function takes (title, bytes done, bytes in total or 0)."""
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
            yield partial(_plain, self.say, decimal if of_bytes else str)
            return
        count = progress.DownloadColumn() if of_bytes else progress.MofNCompleteColumn()
        columns = "{task.description}", progress.BarColumn(), count, progress.TextColumn("{task.fields[text]}")
        with progress.Progress(*columns, progress.TimeRemainingColumn(), console=self.out) as bars:
            yield partial(_bar, bars)

    def results(self, sentence: str, figures: Iterable[tuple[str, str, str]]) -> None:
        """Print the result in a sentence, and figures (name, value, unit) below."""
        self.say(sentence)
        table = Table("", "value", "", box=None, show_header=False)
        table.columns[1].justify = "right"
        for row in figures:
            table.add_row(*row)
        self.out.print(table)

    def next_commands(self, commands: Iterable[str], result: str = "", alarms: Alarms = MappingProxyType({})) -> None:
        """Print a result in one line, and what to do next, one command a line; alarms come in red, with their own."""
        if result:
            self.say(result)
        for said in alarms:
            self.say(said, "bold red")
        for number, command in enumerate([other for others in alarms.values() for other in others] or commands):
            self.say(f"{'      ' if number else 'next: '}{command}")


def _console(stderr: bool) -> Console:
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False, soft_wrap=True)


def _bar(bars: progress.Progress, title: str, total: int | None) -> Show:
    task = bars.add_task(title, total=total, text="")
    return lambda done, known, text: bars.update(task, completed=done, total=known or total, text=text)


class _StepShow(Callback):
    """Callback that shows steps as text of a bar, and lost tracking and loops as lines."""

    def __init__(self, say: Callable[[str], None], begin: Begin, total: int | None, done: int = 0) -> None:
        self.say, self.begin, self.show = say, begin, begin("SLAM", total)
        self.show_final: Show | None = None
        self.final_from = 0, 0.0
        self.started_s = time.perf_counter()
        self.done, self.lost, self.earlier, self.total = done, 0, done, total
        self.lost_since: int | None = None
        self.component = 0

    def __call__(self, step: "Step") -> None:
        self.done += 1
        self.lost += step.lost
        self._print_lost(step)
        self._print_component(step)
        self._print_loops(f"frame {step.index}", step.loops)
        frame_s = max(time.perf_counter() - self.started_s, 1e-9) / (self.done - self.earlier)
        pace = f"{1.0 / frame_s:.1f} frames/s"
        if frame_s > 1.0:  # presets of the papers
            left_min = ((self.total or self.done) - self.done) * frame_s / 60.0
            pace = f"{frame_s:.1f} s per frame" + (f", about {left_min:.0f} min left" if left_min > 1.0 else "")
        warning = "" if self.lost_since is None else f"LOST since frame {self.lost_since}  "
        self.show(self.done, None, f"{warning}{pace}  {step.splats:,} splats  {self.lost} lost")

    def finishing(self, done: int, total: int) -> None:
        """Show the progress of the final map and the time left."""
        now_s = time.perf_counter()
        if self.show_final is None:
            self.show_final, self.final_from = self.begin("final map", total), (done, now_s)
        first, began_s = self.final_from
        left_s = (total - done) * (now_s - began_s) / (done - first) if done > first else None
        self.show_final(done, total, f"about {left_s:.0f} s left" if left_s and done < total else "")

    def last_loops(self, loops: Sequence["Loop"]) -> None:
        """Print the loops closed after the last frame."""
        self._print_loops("at the end", loops)

    def _print_loops(self, when: str, loops: Sequence["Loop"]) -> None:
        for loop in loops:
            if loop.accepted:
                figures = f"residual {loop.residual:.3f}, moved {100.0 * loop.translation_m:.1f} cm"
                self.say(f"{when}: loop closed between submaps {loop.query} and {loop.database} ({figures})")

    def _print_lost(self, step: "Step") -> None:
        where = f"frame {step.index} (t = {step.timestamp_s:.3f} s)"
        if step.lost and self.lost_since is None:
            self.lost_since = step.index
            self.say(f"{where}: tracking lost{f' ({step.diagnosis})' if step.diagnosis else ''}")
        elif not step.lost and self.lost_since is not None:
            how = "relocalised" if step.state == RELOCALISED else "tracking recovered"
            self.say(f"{where}: {how}; it was lost since frame {self.lost_since}")
            self.lost_since = None

    def _print_component(self, step: "Step") -> None:
        component = step.component if step.state == APART else 0
        if step.lost or component == self.component:
            return
        if component > self.component:
            self.say(f"frame {step.index}: component {component} begins, a map that is not connected to the first one")
        else:
            other = f"component {component}" if component else "the first map"
            self.say(f"frame {step.index}: connected to {other}")
        self.component = component


def _plain(say: Callable[[str], None], written: Callable[[int], str], title: str, total: int | None) -> Show:
    last_s, last_line = time.perf_counter(), ""

    def show(done: int, known: int | None, text: str) -> None:
        nonlocal last_s, last_line
        whole, now_s = known or total, time.perf_counter()
        if done in (0, whole) or now_s - last_s >= PLAIN_LINES_EVERY_S:
            line = f"{title} {written(done)}/{'?' if whole is None else written(whole)}  {text}".rstrip()
            line = f"{title} …" if done == 0 and whole is None else line
            if line != last_line:
                say(line)
            last_s, last_line = now_s, line

    return show
