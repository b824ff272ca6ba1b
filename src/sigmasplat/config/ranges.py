"""Declare the valid range of each number beside its setting, and check the values of a section against it.

A type such as `Annotated[int, Range(1)]` declares a range; the aliases below name the usual ones.
"""

import dataclasses
import math
import numbers
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar, get_args, get_origin

from sigmasplat.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Range:
    """The numbers from `least` to `most`, both included unless `open_below`; `or_zero` also allows 0 (often: off)."""

    least: float = -math.inf
    most: float = math.inf
    open_below: bool = False
    or_zero: bool = False

    def __contains__(self, value: float) -> bool:
        """Return whether a number is finite and in the range."""
        if not math.isfinite(value):
            return False
        above = value > self.least if self.open_below else value >= self.least
        return (above and value <= self.most) or (self.or_zero and value == 0)

    def __str__(self) -> str:
        """Describe the range so that it fits after "must be"."""
        below = f"{'above' if self.open_below else 'at least'} {self.least:.10g}"
        if math.isinf(self.least):
            words = "finite" if math.isinf(self.most) else f"at most {self.most:.10g}"
        elif math.isinf(self.most):
            words = below
        elif self.open_below:
            words = f"{below} and at most {self.most:.10g}"
        else:
            words = f"between {self.least:.10g} and {self.most:.10g}"
        return f"0 or {words}" if self.or_zero else words


Count = Annotated[int, Range(0)]
AtLeastOne = Annotated[int, Range(1)]
NotNegative = Annotated[float, Range(0)]
Above0 = Annotated[float, Range(0, open_below=True)]
Share = Annotated[float, Range(0, 1)]
WIDTHS_PX = Range(8, 8192, or_zero=True)

T = TypeVar("T")
PLAIN = frozenset({bool, int, float, str})
_VALID: set[tuple[type, str, type, object]] = set()
"""Values of settings that were valid: presets are made from each other, and most of their values are the same."""


class Section:
    """Base class of the sections of `Config`. Checks every value when a section is made, also by `replace`.

    A subclass gives its name: `class InputConfig(Section, name="input")`; a subclass of a section keeps its name.
    """

    section: ClassVar[str]

    def __init_subclass__(cls, name: str = "") -> None:
        super().__init_subclass__()
        if name:
            cls.section = name

    def __post_init__(self) -> None:
        refuse(self.problems())

    def problems(self) -> list[str]:
        """Describe each invalid value, [] if all are valid. Subclasses add the conditions between several values."""
        return list(problems_of(self, f"{self.section}."))


class FromRow(Generic[T]):
    """A value that belongs to the choice which another setting of the section names: that of the same name in the
    choice's row of a table."""

    def __init__(self, setting: str, table: Mapping[str, Any]) -> None:
        self.setting, self.table, self.name = setting, table, ""

    def __set_name__(self, section: type, name: str) -> None:
        self.name = name

    def __get__(self, section: Any, kind: type) -> T:
        row = self.table[next(iter(self.table)) if section is None else getattr(section, self.setting)]
        value: T = getattr(row, self.name)
        return value


def refuse(problems: list[str]) -> None:
    """Raise ConfigError with all problems in one line, unless there are none."""
    if problems:
        raise ConfigError("; ".join(problems))


def problems_of(values: Any, prefix: str = "") -> Iterator[str]:
    """Yield a description of each field of a dataclass whose value has another type or is out of range."""
    section: Any = type(values)
    for name, _, default, base, range_ in _fields(section):
        value = getattr(values, name)
        plain = type(value) in PLAIN
        if value is default or (plain and (section, name, type(value), value) in _VALID):
            continue
        if problem := _problem(base, range_, value):
            yield f"{prefix}{name} {problem}"
        elif plain:
            _VALID.add((section, name, type(value), value))


def problem_of(kind: Any, value: Any) -> str | None:
    """Describe why a value does not fit a type with its range, as in "must be at least 1, found 0"; None if it fits."""
    return _problem(*unpacked(kind), value)


def _problem(base: Any, range_: Range | None, value: Any) -> str | None:
    """Describe why a value does not fit a type and a range; None if it fits."""
    if get_origin(base) is Literal:
        choices = get_args(base)
        return None if value in choices else f"must be one of {', '.join(map(str, choices))}, found {shown(value)}"
    if base is bool or base is str:
        wanted = "true or false" if base is bool else "text"
        return None if isinstance(value, base) else f"must be {wanted}, found {shown(value)}"
    if base is not int and base is not float:
        return None
    right = numbers.Integral if base is int else numbers.Real
    if isinstance(value, bool) or not isinstance(value, right):
        return f"must be a {'whole ' if base is int else ''}number, found {shown(value)}"
    return out_of_range(range_, value)


def out_of_range(range_: Range | None, value: Any) -> str | None:
    """Describe why a number is not in a range; None if it is, or if only finite numbers are wanted and it is one."""
    try:
        finite = math.isfinite(value)
    except OverflowError:  # a whole number of hundreds of digits
        return f"must be below 2^63, found a number of {value.bit_length()} bits"
    if isinstance(value, int) and value >= 2**63:
        return f"must be below 2^63, found {value}"
    if not finite:
        return f"must be finite{'' if range_ is None else f' and {range_}'}, found {value}"
    return None if range_ is None or value in range_ else f"must be {range_}, found {value}"


def unpacked(kind: Any) -> tuple[Any, Range | None]:
    """Return the type and the range of `Annotated[type, Range(…), …]`; the range is None if none is declared."""
    if get_origin(kind) is not Annotated:
        return kind, None
    base, *extras = get_args(kind)
    return base, next((extra for extra in extras if isinstance(extra, Range)), None)


def shown(value: Any) -> str:
    """Return a value in at most 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def kinds_of(section: Any) -> Mapping[str, Any]:
    """Return the type of each field of a dataclass, with its range."""
    return {name: kind for name, kind, *_ in _fields(section)}


@cache
def _fields(section: Any) -> tuple[tuple[str, Any, Any, Any, Range | None], ...]:
    """Return name, type, default, and the type's base and range of each field.

    The defaults are checked by a test, not again in every object.
    """
    return tuple((f.name, f.type, f.default, *unpacked(f.type)) for f in dataclasses.fields(section))
