"""Write the components of a run that are not connected to the world: components/N/trajectory.txt and map.ply."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sigmasplat.data.component import Component
from sigmasplat.files.atomic import make_folder
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.trajectory import write_trajectory

COMPONENT_FILES = ("trajectory.txt", "map.ply")
"""The files of a component."""


def write_components(folder: Path, components: Sequence[Component]) -> None:
    """Write the path and map of each component N into folder/N, in the component's own frame.

    Files of components that are not given are removed. Raises RunError if a file cannot be written.
    """
    for component in components:
        own = folder / str(component.number)
        make_folder(own)
        write_trajectory(own / "trajectory.txt", component.trajectory)
        ply.write_field(own / "map.ply", component.field)
    for number in set(component_numbers(folder)) - {component.number for component in components}:
        for name in COMPONENT_FILES:
            (folder / str(number) / name).unlink(missing_ok=True)
        _remove_if_empty(folder / str(number))
    _remove_if_empty(folder)


def component_numbers(folder: Path) -> list[int]:
    """Return the numbers of the components in a folder, in ascending order."""
    return sorted(int(entry.name) for entry in folder.glob("*") if entry.name.isdecimal())


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
