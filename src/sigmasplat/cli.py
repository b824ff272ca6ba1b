"""Run the command line: a table of commands, and their exit codes."""

import gc
import os
import resource
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import partial, wraps
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import find_spec
from inspect import cleandoc, signature
from types import CodeType
from typing import Annotated, Any, TextIO, get_args, get_origin

import sigmasplat
from sigmasplat import env
from sigmasplat.errors import ConfigError, SigmaSplatError, is_out_of_memory, nearest, out_of_memory
from sigmasplat.files.reading import cause

REFUSED, INTERRUPTED, CLOSED = 2, 130, 141
LEAST_MEMORY = 1_200_000_000
"""Address space, bytes: a run of tiny images needs that much (1.0 GB was too little with torch 2.13)."""
COLLECTED_AFTER = 10_000
"""New objects after which Python looks for cycles of unused ones. With its own 700, loading torch takes 8 % longer."""
DESCRIPTION = """RGB-D SLAM on 3D Gaussian splats, with uncertainty.

Start with: sigmasplat demo, then: sigmasplat run PATH.

sigmasplat --version    print the version and exit

sigmasplat --plugin FILE.py run PATH    use a file with plug-ins of yours; before or after any command"""

COMMANDS = {
    "demo": ("run", "demo"),
    "inspect": ("inspect", "inspect"),
    "calibrate": ("inspect", "calibrate"),
    "run": ("run", "run"),
    "resume": ("run", "resume"),
    "batch": ("batch", "batch"),
    "localise": ("localise", "localise"),
    "view": ("view", "view"),
    "eval": ("evaluate", "evaluate_run"),
    "mesh": ("mesh", "make_mesh"),
    "export": ("export", "export"),
    "share": ("export", "share"),
    "download": ("download", "download"),
    "bench": ("batch", "bench"),
    "doctor": ("installation", "doctor"),
}
"""Module in `sigmasplat.commands` and function of each command. Only the command that is used is imported."""


def command(name: str) -> Callable[..., int]:
    """Return the function of a command."""
    module, function = COMMANDS[name]
    found: Callable[..., int] = getattr(import_module(f"sigmasplat.commands.{module}"), function)
    return found


def _refuse_unknown(command: str) -> None:
    """Raise ConfigError unless the word is a command or an option."""
    if command not in COMMANDS and not command.startswith("-"):
        raise ConfigError(f"no command '{command}'{nearest(command, COMMANDS)}; the commands are {', '.join(COMMANDS)}")


def _refuse_memory_limit() -> None:
    """Raise ConfigError if the process may use too little memory to load torch, whose loading may then never end."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < LEAST_MEMORY:
        raise ConfigError(
            f"the memory of this process is limited to {limit / 1e6:.0f} MB, but at least {LEAST_MEMORY / 1e6:.0f} MB "
            "of address space are needed; raise the limit (ulimit -v unlimited)"
        )


def _call_of(arguments: Sequence[str]) -> Callable[[], int]:
    """Return the call of the command in the arguments; the options of others are not parsed, which takes time.

    Raises SystemExit after it has printed help, or what is wrong with the arguments.
    """
    import tyro  # not at the top: `--version` and a wrong command do not need it

    name, plain = arguments[0], (tyro.conf.FlagCreatePairsOff,)
    if name not in COMMANDS:
        _list_commands(arguments)
        return lambda: REFUSED
    return tyro.cli(_postponed(name), prog=f"sigmasplat {name}", args=arguments[1:], config=plain)


def _list_commands(arguments: Sequence[str]) -> None:
    """Print the commands, or that there is no such option. Raises SystemExit afterwards."""
    import tyro

    tyro.extras.subcommand_cli_from_dict(
        {name: _without_options(name) for name in COMMANDS},
        prog="sigmasplat",
        description=DESCRIPTION,
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _postponed(name: str) -> Callable[..., Callable[[], int]]:
    """Return a function with the options of a command that returns its call."""
    function = command(name)

    @wraps(function)
    def postponed(*given: Any, **named: Any) -> Callable[[], int]:
        return partial(_run, function, *given, **named)

    return postponed


def _run(function: Callable[..., int], *given: Any, **named: Any) -> int:
    """Check the options of a command and run it. Raises ConfigError with every number out of range."""
    from sigmasplat.config.ranges import refuse

    options = signature(function)
    values = options.bind(*given, **named).arguments
    kinds = {name: options.parameters[name].annotation for name in values}
    refuse([problem for name, value in values.items() for problem in _problems(name, kinds[name], value)])
    return function(*given, **named)


def _problems(name: str, kind: Any, value: Any) -> Iterator[str]:
    """Yield a description of each number out of range, in an option or in a group of options (a dataclass)."""
    from sigmasplat.config.ranges import out_of_range, unpacked

    if is_dataclass(value):
        for field in fields(value):
            yield from _problems(field.name, field.type, getattr(value, field.name))
        return
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and (problem := out_of_range(unpacked(kind)[1], value)):
        yield f"{_option(name, kind)} {problem}"


def _option(name: str, kind: Any) -> str:
    extras = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
    given = (getattr(extra, "name", None) for extra in extras)
    return "--" + (next((own for own in given if own), None) or name).replace("_", "-")


def _without_options(name: str) -> Callable[[], None]:
    """Return a function that stands for a command in the list of commands."""

    def stand_in() -> None:
        """Stand for a command."""

    stand_in.__doc__ = _description(name)
    return stand_in


def _description(name: str) -> str | None:
    """Return a command's docstring, read from the compiled module: `--help` imports no command.

    A paragraph that the import would fill in, as the list of formats of `export`, is left out.
    """
    module, function = COMMANDS[name]
    path = f"sigmasplat.commands.{module}"
    spec = find_spec(path)
    compiled = spec.loader.get_code(path) if spec and isinstance(spec.loader, InspectLoader) else None
    for part in compiled.co_consts if compiled else ():
        if isinstance(part, CodeType) and part.co_name == function and isinstance(part.co_consts[0], str):
            return "\n\n".join(p for p in cleandoc(part.co_consts[0]).split("\n\n") if not p.startswith("{"))
    return None  # python -OO


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 problems found (doctor, inspect), no image found (localise) or a run failed
    (batch, bench table), 2 refused with one line, 130 interrupted, 141 standard output was closed (as by `| head`)."""
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if given == ["--version"]:
        print(f"sigmasplat {sigmasplat.__version__}")
        sys.exit(0)
    warnings.filterwarnings("ignore", "Image size .* exceeds limit")  # our limit is lower (`files/pictures.py`)
    try:
        env.switches()
        given = _with_plugins(given)
        _refuse_unknown(given[0])
        _refuse_memory_limit()
        with _without_collection():
            call = _call_of(given)
        code = call()
        sys.stdout.flush()
    except SigmaSplatError as problem:
        code = _refused(str(problem))
    except BrokenPipeError:
        _silence(sys.stdout)
        code = CLOSED
    except KeyboardInterrupt:
        _print_error("sigmasplat: interrupted")
        code = INTERRUPTED
    except Exception as problem:
        if is_out_of_memory(problem):
            code = _refused(out_of_memory(problem))
        elif isinstance(problem, OSError):
            name = "" if problem.filename is None else f"{problem.filename}: "
            code = _refused(f"{name}{cause(problem)}; check the path, its permissions and the free space")
        else:
            raise
    sys.exit(code)


@contextmanager
def _without_collection() -> Iterator[None]:
    """Never look for cycles of unused objects among what is loaded for the options: it stays in use until the exit."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(COLLECTED_AFTER)
        gc.enable()


def _with_plugins(given: Sequence[str]) -> list[str]:
    """Use the files of all --plugin options; return the other arguments. Raises ConfigError if a file is missing."""
    rest, files, words = list[str](), list[str](), iter(given)
    for word in words:
        name, equals, value = word.partition("=")
        if name != "--plugin":
            rest.append(word)
        elif not (file := value if equals else next(words, "")):
            raise ConfigError("--plugin needs a file; give a Python file that defines PLUGIN")
        else:
            files.append(file)
    if files:
        from sigmasplat.registry import use_files

        use_files(files)
    return rest or ["--help"]


def _refused(message: str) -> int:
    _print_error(f"sigmasplat: {' '.join(message.splitlines())}")
    return REFUSED


def _print_error(line: str) -> None:
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:  # closed, too: the exit code must do
        _silence(sys.stderr)


def _silence(stream: TextIO) -> None:
    """Send a stream whose reader has gone to /dev/null, so that flushing it at exit does not fail."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    main()
