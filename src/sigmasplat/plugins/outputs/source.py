"""What is exported: a run folder, or a map's PLY. Imports that load torch are inside the functions."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sigmasplat.api import RunError

if TYPE_CHECKING:
    from sigmasplat.api import GaussianField, RunFolder, SplatStd
    from sigmasplat.plugins.outputs.run_reader import RunReader


@dataclass(frozen=True)
class ExportSource:
    """What is exported: a run folder, or a PLY that holds a map."""

    path: Path

    @property
    def name(self) -> str:
        """Return the default name of exports: the run's name, or the file's name without its ending."""
        path = self.path.resolve()
        return path.stem if path.is_file() else path.name

    def run(self) -> "RunFolder":
        """Open the run. Raises RunError if there is no run, or if the source is a map."""
        from sigmasplat.api import RunFolder

        if self.path.is_file():
            raise RunError(f"{self.path} is a file, which can be exported only as another map; give a run folder")
        return RunFolder.open(self.path)

    def reader(self) -> "RunReader":
        """Open the run to read its path, camera and keyframe images. Raises RunError as `run` does."""
        from sigmasplat.plugins.outputs.run_reader import RunReader

        return RunReader(self.run())

    def splats(self) -> "tuple[GaussianField, SplatStd | None]":
        """Read the map, and the standard deviations of its splats if a run has measured them.

        Raises RunError if there is no run, SourceError if the map cannot be read.
        """
        from sigmasplat.api import splat_ply

        if self.path.is_file() or (not self.path.exists() and self.path.suffix != ""):
            return splat_ply.read_field(self.path), None
        run = self.run()
        return run.read_splat_std() or (run.read_map(), None)
