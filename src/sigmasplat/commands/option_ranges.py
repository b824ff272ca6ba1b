"""Define numbers as options, and check them against the ranges that their types declare, before a command starts."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from inspect import signature
from typing import Annotated, Any, get_args, get_origin

import tyro

from sigmasplat.config.ranges import Range, out_of_range, refuse, unpacked


def _number(read: Callable[[str], float]) -> tyro.constructors.PrimitiveConstructorSpec[float | None]:
    """Describe an optional number: None if it is not given; a given text is always read as a number, never as None."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NUMBER",
        instance_from_str=lambda given: read(given[0]),
        is_instance=lambda value: value is None or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


Whole = Annotated[int | None, _number(int)]
Number = Annotated[float | None, _number(float)]
From0 = Annotated[Number, Range(0)]
From1 = Annotated[int, Range(1)]


def checked(command: Callable[..., int]) -> Callable[..., int]:
    """Return the command with a check of its options. Raises ConfigError with every number out of range."""

    @functools.wraps(command)
    def run(*given: Any, **named: Any) -> int:
        parameters = signature(command)
        values = parameters.bind(*given, **named).arguments
        kinds = {name: parameters.parameters[name].annotation for name in values}
        refuse([problem for name, value in values.items() for problem in _problems(name, kinds[name], value)])
        return command(*given, **named)

    return run


def _problems(name: str, kind: Any, value: Any) -> Iterator[str]:
    """Yield a description of each number out of range, in an option or in a group of options (a dataclass)."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _problems(field.name, field.type, getattr(value, field.name))
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and (problem := out_of_range(unpacked(kind)[1], value)):
        yield f"{_option(name, kind)} {problem}"


def _option(name: str, kind: Any) -> str:
    """Return the option's name on the command line."""
    extras = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
    given = (getattr(extra, "name", None) for extra in extras)
    return "--" + (next((own for own in given if own), None) or name).replace("_", "-")
