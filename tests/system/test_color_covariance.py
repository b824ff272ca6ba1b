"""A run with full colour covariances: it writes them, and they are read back."""

from pathlib import Path

import pytest

from command_line import exit_code
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

QUICK = {
    "input.width": 80, "mapping.first_iterations": 4, "mapping.iterations": 3, "mapping.every": 2, "submaps.frames": 4,
    "final.iterations": 4, "mapping.color_covariance": "full",
}  # fmt: skip
ROOM = "synthetic:frames=120,width=80,height=60"


def test_full_colour_covariances_are_in_the_map_and_the_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [word for name, value in QUICK.items() for word in ("--set", f"{name}={value}")]
    arguments = ["run", ROOM, "--limit", "10", "--no-eval", "--out", str(tmp_path / "run"), *settings]
    assert exit_code(*arguments) == 2
    refusal = capsys.readouterr().err
    assert refusal.count("\n") == 1 and "mapping.weight_moment=0" in refusal and not (tmp_path / "run").exists()

    assert exit_code(*arguments, "--set", "mapping.weight_moment=0", "--set", "render.depth=center") == 0
    run = RunFolder(tmp_path / "run")
    field, (tensors, _) = run.read_map(), run.read_checkpoint()
    correlations = field.attributes["correlations"].params
    assert correlations.shape == (len(field), 3) and float(correlations.abs().max()) > 0.0
    assert tensors["correlations_params"].shape == (len(tensors["params"]), 3)
    assert tensors["correlations_moment1"].abs().max() > 0.0
