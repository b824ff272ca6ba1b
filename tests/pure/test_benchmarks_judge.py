"""benchmarks/judge.py: poses are drawn from a recording with truth, wrong ones look worse, a model tells them apart."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.tracking.pose_validation import BIAS, WEIGHTS

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
judge: Any = importlib.import_module("judge")
ROOM = "synthetic:frames=24,width=96,height=72"


def test_poses_are_drawn_and_the_shipped_model_tells_wrong_ones(tmp_path: Path) -> None:
    found = judge.measure_source(ROOM, 80, 3, tmp_path)
    assert len(found["inputs"]) == len(found["shifts"]) >= 80
    assert found == judge.measure_source(ROOM, 80, 3, tmp_path)
    poses = judge.Poses.of(found)
    assert 0.05 < poses.wrong.mean() < 0.6
    p = judge.probability(np.array([BIAS, *WEIGHTS.values()]), poses.inputs)
    assert judge.judged(p, poses.wrong)["auroc"] > 0.95
    assert p[poses.wrong].mean() > 0.6 and p[~poses.wrong].mean() < 0.2


def test_each_recording_is_judged_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recording b has other weights: a model that had seen it would judge it right."""
    random = np.random.default_rng(0)

    def drawn(source: str, **_: Any) -> dict[str, Any]:
        inputs = random.uniform(-1.0, 1.0, (400, len(WEIGHTS)))
        of = inputs[:, 0] if source == "b" else inputs[:, 1]
        return {"inputs": inputs.tolist(), "shifts": np.where(of > 0.2, 0.4, 0.001).tolist()}

    class Here:
        def __init__(self, _: int) -> None: ...
        def __enter__(self) -> "Here":
            return self

        def __exit__(self, *_: object) -> None: ...

        map = staticmethod(map)

    monkeypatch.setattr(judge, "measure_source", drawn)
    monkeypatch.setattr(judge, "ProcessPoolExecutor", Here)
    found = judge.measure(judge.Options(sources=("a", "b", "c", judge.ONLY_JUDGED)))
    assert found["held_out"]["a"]["auroc"] > 0.75 > 0.6 > found["held_out"]["b"]["auroc"]
    tables = laid_out("judge", found)
    assert [row[0] for row in tables["Each recording by a model without it"].rows][-1] == "all but the corridor"
    assert {row[0] for row in tables["Weights"].rows} == {"bias", *WEIGHTS}


def test_poses_between_right_and_wrong_are_left_out() -> None:
    poses = judge.Poses.of({"inputs": [[0.0], [1.0], [2.0]], "shifts": [judge.RIGHT / 2, judge.WRONG - 1e-6, 1.0]})
    assert poses.inputs.tolist() == [[0.0], [2.0]] and poses.wrong.tolist() == [False, True]
