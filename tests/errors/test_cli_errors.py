"""Bad input at the command line: one clear line on standard error, exit code 2, nothing written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sigmasplat import cli
from sigmasplat.commands.input_options import InputOptions


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must be refused and return its message."""
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    said = capsys.readouterr()
    assert left.value.code == 2, said
    assert said.err.startswith("sigmasplat: ")
    assert said.err.count("\n") == 1
    assert said.out == ""
    return said.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["rnu", "data/kitchen"], "no command 'rnu' (did you mean run?); the commands are demo, "),
        (["evaluate", "--help"], "no command 'evaluate' (did you mean eval?)"),
        (
            ["xyzzy"],
            "no command 'xyzzy'; the commands are demo, inspect, calibrate, run, resume, batch, localise",
        ),
        (["run", "/no/such/place"], "/no/such/place"),
        (["run", "."], "unknown format"),
        (["run", "/no/such/place", "--preset", "quick"], "no preset 'quick'"),
        (["run", "/no/such/place", "--set", "tracking.speed=9"], "unknown setting 'tracking.speed'"),
        (["run", "/no/such/place", "--set", "fast"], "SECTION.NAME=VALUE"),
        (["run", "/no/such/place", "--seed", "-1"], "seed must be at least 0, found -1"),
        (["demo", "--frames", "0"], "--frames must be at least 1"),
        (["run", "/no/such/place", "--save-every", "nan"], "--save-every must be finite and at least 0, found nan"),
        (["run", "/no/such/place", "--save-every", "-1", "--port", "70000"], "--save-every must be at least 0"),
        (["run", "/no/such/place", "--save-every", "-1", "--port", "70000"], "--port must be between 0 and 65535"),
        (["run", "/no/such/place", "--final-seconds", "inf"], "--final-seconds must be finite"),
        (["run", "/no/such/place", "--limit", "0", "--stride", "1"], "--limit must be at least 1, found 0"),
        (["run", "/no/such/place", "--stride", "0"], "--stride must be at least 1, found 0"),
        (["run", "/no/such/place", "--fx", "-500", "--start", "nan"], "--start must be finite"),
        (["run", "/no/such/place", "--set", "mapping.every=0", "--set", "input.width=1"], "input.width must be 0 or"),
        (["run", "/no/such/place", "--set", "mapping.every=0", "--set", "input.width=1"], "mapping.every must be at"),
        (["export", "/no/such/run", "--fps", "-30"], "--fps must be between 1 and 120, found -30"),
        (["export", "/no/such/run", "--std-below-m", "-1"], "--std-below-m must be at least 0"),
        (["mesh", "/no/such/run", "--voxel-m", "nan"], "--voxel-m must be finite and above 0"),
        (["bench", "table", "tum", "--seeds", "0"], "--seeds must be at least 1"),
        (["batch", "/no/such/place", "--jobs", "0"], "--jobs must be at least 1"),
        (["demo", "--frames", "3", "--set", "tracking.method=guess"], "must be one of adam, align"),
        (["eval", "/no/such/run"], "no run folder /no/such/run"),
        (["eval", "."], "not a run folder"),
        (["export", "/no/such/run"], "no run folder /no/such/run"),
    ],
    ids=" ".join,
)
def test_refusals(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert says in refused(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_touched(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("ten years of work")
    sequence = "synthetic:frames=2"
    assert "not empty" in refused(capsys, "run", sequence, "--out", str(tmp_path))
    assert "not a run folder" in refused(capsys, "run", sequence, "--out", str(tmp_path), "--overwrite")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_an_unwritable_place_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert "cannot write" in refused(capsys, "run", "synthetic:frames=2", "--out", str(tmp_path / "run"))


def test_output_below_a_file_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "cannot write" in refused(capsys, "run", "synthetic:frames=2", "--out", str(tmp_path / "file" / "run"))


def _sigmasplat(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sigmasplat.cli", *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=60)


def test_the_version_is_listed_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["--help"])
    assert left.value.code == 0 and "sigmasplat --version    print the version" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        cli.main(["--version"])
    assert left.value.code == 0 and capsys.readouterr().out.startswith("sigmasplat ")


def test_a_bad_environment_switch_is_one_line() -> None:
    answer = _sigmasplat("doctor", SIGMASPLAT_ISA="sse9")
    assert answer.returncode == 2
    assert answer.stderr == "sigmasplat: SIGMASPLAT_ISA is 'sse9'; give one of auto, avx512, avx2, baseline\n"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["run", "--help"], ["export", "--help"]])
def test_help_has_an_example_and_loads_no_torch(arguments: list[str]) -> None:
    code = "import sys, sigmasplat.cli as c\ntry: c.main(sys.argv[1:])\nfinally: assert 'torch' not in sys.modules"
    answer = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60)
    assert answer.returncode == 0, answer.stderr
    assert "example: sigmasplat" in answer.stdout


def test_the_overview_describes_each_command_and_imports_none() -> None:
    code = "import sys, sigmasplat.cli as c\ntry: c.main([])\nfinally: print('LOADED', *sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    overview, loaded = answer.stdout.split("LOADED")
    assert {f"sigmasplat.commands.{module}" for module, _ in cli.COMMANDS.values()}.isdisjoint(loaded.split())
    words = " ".join(overview.replace("│", " ").split())
    for name in cli.COMMANDS:
        described = " ".join((cli.command(name).__doc__ or "").split("\n\n")[0].split())
        assert f"{name} {described}" in words


@pytest.mark.parametrize(
    "mistyped",
    ["run x --fx 57O", "run x --limit many", "run x --stride 1.5", "run x --seed None", "run x --register-depth None",
     "inspect x --depth-scale 1OOO", "export x --std-below-m small"],
)  # fmt: skip
def test_the_message_for_a_mistyped_number_has_no_parser_types(
    mistyped: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.main(mistyped.split())
    told = capsys.readouterr().err
    assert f"'{mistyped.split()[-1]}'" in told and mistyped.split()[-2] in told and told.count("\n") <= 12
    for internal in ("NoneType", "{None}", "type matching", "'None',"):
        assert internal not in told


@pytest.mark.parametrize("command", ["run", "inspect", "localise", "export", "bench", "mesh", "eval", "resume", "demo"])
def test_help_does_not_show_none(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    assert "None" not in capsys.readouterr().out


def test_input_options_become_settings() -> None:
    assert InputOptions().settings() == InputOptions(register_depth="auto").settings() == {}
    given = InputOptions(limit=3, start=1.5, fx=570.5, strict=True, register_depth="off").settings()
    assert given == {"input.limit": "3", "input.start_s": "1.5", "input.fx": "570.5", "input.strict": "True",
                     "input.register_depth": "off"}  # fmt: skip


@pytest.mark.parametrize("arguments", [["fly"], ["run"], ["run", "x", "--limit", "many"], ["run", "x", "--no-such"]])
def test_mistyped_commands_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert left.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_an_option_of_another_command_is_refused_with_the_way_to_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["eval", "runs/none", "--limit", "5"])
    error = " ".join(capsys.readouterr().err.split())
    assert "Unrecognized options: --limit" in error and "sigmasplat eval --help" in error


def test_a_command_does_not_load_the_others() -> None:
    code = "import sys; from sigmasplat.cli import main\ntry: main(['view', 'none'])\nfinally: print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    parts = [name.split(".") for name in ended.stdout.split()]
    commands = {
        name for package, *rest in parts if package == "sigmasplat" and rest[:1] == ["commands"] for name in rest
    }
    assert "no run folder none" in ended.stderr and "view" in commands
    assert not commands & {"run", "bench", "batch", "inspect", "localise"}
