"""benchmarks/graph_ablation.py: each variant replaces its part of the package, only while it runs."""

import importlib
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.config.submaps import LoopConfig
from sigmasplat.data import se3
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.errors import ConfigError
from sigmasplat.final import stores
from sigmasplat.graph import keyframe_graph
from sigmasplat.graph.keyframe_graph import solve

ablation: Any = importlib.import_module("graph_ablation")


def triangle() -> tuple[Any, list[RelativePose]]:
    """Return three poses, and edges that contradict each other; the hops are surer than the alignment."""
    T = se3.exp_stack(np.array([[0.0] * 6, [0.1, 0, 0, 0, 0, 0], [0.2, 0, 0, 0, 0, 0]]))
    ends, shifts, stds = ((1, 0), (2, 1), (2, 0)), (-0.1, -0.1, -0.23), (1e-3, 1e-3, 1e-1)
    edges = [
        RelativePose(a, b, se3.exp(np.array([shift, 0, 0, 0, 0, 0])), np.eye(6) / std**2, "alignment")
        for (a, b), shift, std in zip(ends, shifts, stds, strict=True)
    ]
    return T, edges


def test_a_variant_replaces_its_part_while_it_runs() -> None:
    T, edges = triangle()
    graph, most = keyframe_graph.GrowingGraph(8), LoopConfig.alignments
    before = keyframe_graph.GrowingGraph.solved, keyframe_graph.solve, stores.solve
    variant = ablation.Variant(edges=3, window=False, weights=False)
    with variant.in_place():
        assert LoopConfig().alignments == 3
        assert np.array_equal(graph.solved(T, [RelativePose.hop(np.eye(4))] * 2, 1), T[1:])
        assert keyframe_graph.solve is stores.solve is ablation.solve_unweighted
        equal = stores.solve(T, edges).T_world_keyframe
    assert (keyframe_graph.GrowingGraph.solved, keyframe_graph.solve, stores.solve) == before
    assert LoopConfig.alignments == most == ablation.VARIANTS["as it is"].edges
    assert solve(T, edges).T_world_keyframe[2, 0, 3] == pytest.approx(0.2, abs=1e-3)
    assert equal[2, 0, 3] == pytest.approx(0.22, abs=2e-3)  # the error of 3 cm is shared by three equal edges


def test_rows_are_variants_and_columns_recordings() -> None:
    figures = {"problem": None, "ate_m": 0.02, "windows_in": 0.5, "windows_k": 3.0, "lost": 0, "edges": None,
               "loops": 1, "cpu_s": 0.05}  # fmt: skip
    runs = [
        {"source": s, "variant": v, "seed": 0, **figures} for s in ("desk", "room") for v in ("as it is", "3 edges")
    ]
    runs += [
        runs[0] | {"seed": 1, "ate_m": 0.04},
        {"source": "room", "variant": "3 edges", "seed": 1, "problem": "gone"},
    ]
    made = laid_out("graph_ablation", {"runs": runs})
    assert list(made["ATE, cm"].columns) == ["variant", "desk", "room"]
    assert made["ATE, cm"].rows == [["as it is", "3.00", "2.00"], ["3 edges", "2.00", "2.00"]]
    assert made["edges"].rows[0][1:] == ["–", "–"] and made["Failed"].rows == [["room, 3 edges, seed 1", "gone"]]
    with pytest.raises(ConfigError, match="no variant '4 edges'; there are 'as it is', "):
        ablation.measure_all(ablation.Options(variants=("4 edges",)))
