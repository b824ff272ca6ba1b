"""Run the command line in this process."""

import pytest

from sigmasplat import cli


def exit_code(*arguments: str) -> int:
    """Run `sigmasplat` with these arguments; return its exit code."""
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert isinstance(left.value.code, int)
    return left.value.code
