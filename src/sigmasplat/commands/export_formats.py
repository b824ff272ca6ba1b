"""Say what a format of `sigmasplat export` is: a row of its table, and what the row's writer is given."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.commands import options
from sigmasplat.errors import ConfigError, RunError

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.model.field import GaussianField


@dataclass(frozen=True)
class Origin:
    """What is exported: the folder of a run, or a file that holds a map."""

    path: Path

    @property
    def name(self) -> str:
        """Return the name that exports of it have unless one is given: the run's, or the file's without its ending."""
        path = self.path.resolve()
        return path.stem.removesuffix(".compressed") if path.is_file() else path.name

    def run(self) -> "RunFolder":
        """Open the run. Raises RunError if there is none, or if it is a map."""
        from sigmasplat.io.runs import RunFolder

        if self.path.is_file():
            raise RunError(
                f"{self.path} is a file; a map can be exported to formats of maps only, else give a run folder"
            )
        return RunFolder.open(self.path)

    def field(self) -> "GaussianField":
        """Read the map. Raises RunError if there is no run, SourceError if the map is damaged or none."""
        from sigmasplat.io.splats.any_format import read_any

        is_map = self.path.is_file() or (not self.path.exists() and self.path.suffix != "")
        return read_any(self.path) if is_map else self.run().read_map()


@dataclass(frozen=True)
class ExportOptions:
    """Options that only some formats obey (`Format.obeys`), by their names on the command line."""

    sigma_below: options.SigmaBelow = None
    opacity_above: options.OpacityAbove = None
    plain: options.Plain = False
    pictures: options.Pictures = False
    voxel_m: options.VoxelM = 0.01
    size: options.FilmSize = 0
    fps: options.FilmRate = 25.0
    seconds: options.FilmSeconds = None
    path: options.FilmPath = "run"
    cell_m: options.CellM = 0.05
    source: options.MovedSource = None

    def given(self) -> list[str]:
        """Name the options that are not as they are by default."""
        return [option.name for option in fields(self) if getattr(self, option.name) != option.default]


@dataclass(frozen=True)
class Format:
    """A row of the table: a name for --format, the endings that choose it, one line of help, and its writer.

    The first row with an ending owns it. The first ending is given to exports without --out. `write` makes the target,
    a file or folder that is not there yet or may be replaced, and says in a few words what it holds. `obeys` names the
    `ExportOptions` that it reads.
    """

    name: str
    endings: tuple[str, ...]
    help: str
    write: Callable[[Origin, Path, ExportOptions], str]
    obeys: tuple[str, ...] = ()


def owners(formats: tuple[Format, ...]) -> dict[str, Format]:
    """Return which format each ending chooses: the first that has it."""
    endings: dict[str, Format] = {}
    for row in formats:
        for ending in row.endings:
            endings.setdefault(ending, row)
    return endings


def listed(formats: tuple[Format, ...]) -> list[str]:
    """Return a line of help for each format: the endings that choose it, its name, what it is."""
    own = owners(formats)
    endings = (", ".join(ending for ending in row.endings if own[ending] is row) or "--format" for row in formats)
    return [f"{ending:<15} {row.name}: {row.help}" for ending, row in zip(endings, formats, strict=True)]


def choose(formats: tuple[Format, ...], name: str | None, out: Path | None) -> Format:
    """Return the format of that name; else the one whose ending `out` has; else, where no `out` is given, the first.

    Raises ConfigError where there is none.
    """
    if name is not None:
        named = [row for row in formats if row.name == name]
        if not named:
            raise ConfigError(f"no format '{name}'; there are {', '.join(row.name for row in formats)}")
        return named[0]
    if out is None:
        return formats[0]
    endings = owners(formats)
    fitting = [ending for ending in endings if out.name.lower().endswith(ending)]
    if not fitting:
        raise ConfigError(
            f"cannot tell by the name {out} what to write; end it in {', '.join(endings)}, or give --format"
        )
    return endings[max(fitting, key=len)]


def refuse_unobeyed(chosen: Format, formats: tuple[Format, ...], options: ExportOptions) -> None:
    """Raise ConfigError if an option is given that the format does not obey."""
    for option in options.given():
        if option not in chosen.obeys:
            others = ", ".join(row.name for row in formats if option in row.obeys)
            raise ConfigError(
                f"--{option.replace('_', '-')} does not go with format {chosen.name}; it goes with {others}"
            )
