"""Make sections of settings in which constants differ, and what follows another setting: for tests of the methods that
use them."""

import dataclasses
from typing import Any, TypeVar

Section = TypeVar("Section")


def made(kind: type[Section], **values: Any) -> Section:
    """Make a section; values that are no settings become class attributes of a subclass."""
    settings = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    constants = {name: values.pop(name) for name in values.keys() - settings}
    assert all(hasattr(kind, name) for name in constants), constants
    return (type(kind.__name__, (kind,), constants) if constants else kind)(**values)


def changed(section: Section, **values: Any) -> Section:
    """Return a section with some values replaced, as `made` makes it."""
    old = {field.name: getattr(section, field.name) for field in dataclasses.fields(section)}  # type: ignore[arg-type]
    return made(type(section), **(old | values))
