"""Show a run on a terminal, or as plain lines where there is none."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from sigmasplat.metrics.report import headline, number
from sigmasplat.profile import shares
from sigmasplat.session import Stepped

PLAIN_LINES_EVERY_S = 10.0


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
    def steps(self, total: int) -> Iterator[Callable[[Stepped], None]]:
        """Show the steps of a run: a bar with frames/s, splats and lost frames; a line where tracking is lost."""
        with self._bar("SLAM", total) as show:
            yield _StepShow(self.say, show)

    @contextmanager
    def counting(self, title: str) -> Iterator[Callable[[int, int], None]]:
        """Show a count (done, total)."""
        with self._bar(title, None) as show:
            yield lambda done, total: show(done, total, "")

    @contextmanager
    def _bar(self, title: str, total: int | None) -> Iterator[Callable[[int, int | None, str], None]]:
        if not self.out.is_terminal:
            yield _PlainShow(self.say, title, total)
            return
        columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[text]}"))
        with Progress(*columns, TimeRemainingColumn(), console=self.out) as bar:
            task = bar.add_task(title, total=total, text="")
            yield lambda done, known, text: bar.update(task, completed=done, total=known or total, text=text)

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
            self.say(f"tracking was LOST on {len(lost)} of {frames} frames: {_ranges(lost)}; do not trust those poses")

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
    training = ("PSNR, training", number((metrics.get("training") or {}).get("psnr_db"), 2), "dB")
    place = 1 + next((i for i, row in enumerate(rows) if row[0].startswith("PSNR")), len(rows) - 1)
    return [*rows[:place], training, *rows[place:]]


def _ranges(indices: list[int], most: int = 4) -> str:
    """Write increasing indices as ranges: 3–5, 9."""
    runs: list[list[int]] = []
    for i in indices:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    words = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs[:most]]
    return ", ".join(words) + (", …" if len(runs) > most else "")


class _StepShow:
    """Turn steps into text for a bar, and losses into lines."""

    def __init__(self, say: Callable[[str], None], show: Callable[[int, int | None, str], None]) -> None:
        self.say, self.show = say, show
        self.started_s = time.perf_counter()
        self.done = self.lost = 0
        self.lost_since: int | None = None

    def __call__(self, step: Stepped) -> None:
        self.done += 1
        self.lost += step.lost
        self._tell_losses(step)
        speed = self.done / max(time.perf_counter() - self.started_s, 1e-9)
        self.show(self.done, None, f"{speed:.1f} frames/s  {step.splats:,} splats  {self.lost} lost")

    def _tell_losses(self, step: Stepped) -> None:
        where = f"frame {step.index} (t = {step.timestamp_s:.3f} s)"
        if step.lost and self.lost_since is None:
            self.lost_since = step.index
            self.say(f"{where}: tracking lost")
        elif not step.lost and self.lost_since is not None:
            self.say(f"{where}: tracking found again, lost since frame {self.lost_since}")
            self.lost_since = None


class _PlainShow:
    """Print a line now and then, and at the end."""

    def __init__(self, say: Callable[[str], None], title: str, total: int | None) -> None:
        self.say, self.title, self.total = say, title, total
        self.last_s = time.perf_counter()

    def __call__(self, done: int, known: int | None, text: str) -> None:
        total = known or self.total
        now_s = time.perf_counter()
        if done == total or now_s - self.last_s >= PLAIN_LINES_EVERY_S:
            self.last_s = now_s
            self.say(f"{self.title} {done}/{total}  {text}".rstrip())
