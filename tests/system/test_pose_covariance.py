"""The covariance of a run's poses, from the run to metrics.json and to the exported file, on a few small frames."""

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import exit_code

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SETTINGS = {
    "input.limit": "60", "mapping.first_iterations": "60", "mapping.iterations": "8", "submaps.frames": "20",
    "final.iterations": "0", "tracking.features": "off", "final.move_poses": "no",
}  # fmt: skip
"""The covariance is that of the path before the graph of keyframes corrects it."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "room"
    settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    room = "synthetic:frames=200,width=160,height=120,noise=1"
    assert exit_code("run", room, "--out", str(out), *settings) == 0
    return out


@pytest.mark.slow
def test_errors_of_the_path_are_of_the_size_that_the_covariance_says(run: Path) -> None:
    scores = json.loads((run / "metrics.json").read_text())["pose_covariance"]
    assert scores["hops"]["count"] >= 11 and scores["windows"]["count"] == 10 and scores["from_start"]["count"] == 59
    for name in ("hops", "windows", "from_start"):
        assert 0.5 < scores[name]["nees_mean"] < 40.0, name
        assert 0.05 < scores[name]["position_k"] < 10.0, name  # windows in seven such rooms: 0.8 to 8.7
    assert scores["hops"]["coverage_90"] > 0.6


@pytest.mark.slow
def test_the_exported_path_is_certain_at_the_start_and_nowhere_else(run: Path, tmp_path: Path) -> None:
    assert exit_code("export", str(run), "--out", str(tmp_path / "path.cov.txt")) == 0
    rows = np.loadtxt(tmp_path / "path.cov.txt")
    covariances = np.zeros((len(rows), 6, 6))
    covariances[:, *np.tril_indices(6)] = rows[:, 8:]
    covariances[:, *np.triu_indices(6)] = np.swapaxes(covariances, 1, 2)[:, *np.triu_indices(6)]
    assert 0.0 < covariances[0].max() < 0.1 * np.diagonal(covariances[1:], axis1=1, axis2=2).min()
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    std_m = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    assert std_m[10] < std_m[-1] < 0.1
