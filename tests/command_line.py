"""Run the command line in the test's own process."""

import pytest

from sigmasplat import cli


def sigmasplat(*arguments: str) -> int:
    """Run `sigmasplat` with these arguments and return its exit code."""
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert isinstance(left.value.code, int)
    return left.value.code
