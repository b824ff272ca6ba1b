"""Errors of keyframes in their solved graph: against solutions of disturbed edges, and against drawn errors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import chi2

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.relative_pose import Edges, Kind, RelativePose, SolvedGraph
from sigmasplat.final.stores import KeyframeNodes
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.graph import graph_errors
from sigmasplat.graph.graph_errors import (
    CALIBRATION,
    STAMP,
    GraphErrors,
    calibration_std,
    moved_by_camera,
    shared_errors,
)
from sigmasplat.graph.keyframe_graph import solve
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.graph.pose_graph import PoseGraph, minimise
from sigmasplat.system.slam import path_errors

Array = NDArray[np.float64]
NOISE, SAME = np.array([0.002] * 3 + [0.001] * 3), np.array([0.001] * 3 + [0.0005] * 3)  # m, rad
NODES = 24
TRUTH = np.stack([np.linalg.matrix_power(se3.exp(np.array([0.1, 0, 0.02, 0, 0.2, 0])), i) for i in range(NODES)])


def pairs() -> list[tuple[int, int, Kind]]:
    hops: list[tuple[int, int, Kind]] = [(i, i - 1, "hop") for i in range(1, NODES)]
    return hops + [(i, i - d, "alignment") for d in (1, 2, 4, 7) for i in range(d, NODES)]


def measured(rng: np.random.Generator, claimed: float = 1.0) -> list[RelativePose]:
    """Draw edges with independent errors, and one error that is the same in all of them."""
    same = rng.normal(size=6) * SAME
    return [
        RelativePose(
            a, b, se3.exp(rng.normal(size=6) * NOISE + same) @ se3.inverse(TRUTH[a]) @ TRUTH[b],
            np.diag((claimed * NOISE) ** -2.0), kind, bias=SAME,
        )
        for a, b, kind in pairs()
    ]  # fmt: skip


def solved(edges: list[RelativePose], fixed: int = 1) -> SolvedGraph:
    chain = [se3.inverse(edge.T_a_b) for edge in edges[: NODES - 1]]
    start = np.stack([np.eye(4), *itertools.accumulate(chain, np.matmul)])
    start[:fixed] = TRUTH[:fixed]
    solution = solve(start, edges, fixed)
    ends = np.array([(edge.a, edge.b) for edge in edges])
    T_a_b = np.stack([edge.T_a_b for edge in edges])
    shared = shared_errors(edges, np.zeros((NODES, 6)), [], None)
    return SolvedGraph(np.arange(NODES), solution.T_world_keyframe, fixed, ends, T_a_b, solution.information, shared)


@pytest.mark.parametrize("fixed", [1, 4])
def test_errors_are_those_of_the_solution_of_disturbed_edges(fixed: int) -> None:
    """Central differences of the solved poses in one edge's error, and in the error that all edges share."""
    graph = solved(measured(np.random.default_rng(0)), fixed)
    error, size = GraphErrors(graph).of(20), 0.1

    def pose(disturbed: Array) -> Array:
        T_a_b = np.stack([se3.exp(xi) @ T for xi, T in zip(disturbed, graph.T_a_b, strict=True)])
        edges = [
            RelativePose(*ends, T, information)
            for ends, T, information in zip(graph.ends.tolist(), T_a_b, graph.information, strict=True)
        ]
        problem = PoseGraph(NODES, edges, fixed)
        return minimise(problem, graph.T_world_node, np.ones(len(edges)), 20, 0.0)[0][20]

    def slope(one: Array) -> Array:
        return se3.log(pose(size * one) @ se3.inverse(pose(-size * one))) / (2 * size)

    for edge, axis in [(3, 0), (30, 4), (70, 2)]:
        one = np.zeros((len(graph.ends), 6))
        one[edge] = np.linalg.inv(np.linalg.cholesky(graph.information[edge])).T[:, axis]
        assert np.allclose(error[:, 6 * edge + axis], slope(one), rtol=0.05, atol=5e-7)
    for axis in (0, 4):
        one = np.zeros((len(graph.ends), 6))
        one[:, axis] = SAME[axis]
        assert np.allclose(error[:, axis - 11], slope(one), rtol=0.05, atol=5e-7)


def test_nine_of_ten_errors_lie_in_their_ellipsoids() -> None:
    """The noise is claimed to be a third of what it is, and the redundancy measures it. One node of 80 graphs."""
    inside = 0
    for seed in range(80):
        graph = solved(measured(np.random.default_rng(seed), 0.3))
        error = GraphErrors(graph).of(15)
        off = se3.log(TRUTH[15] @ se3.inverse(graph.T_world_node[15]))
        inside += bool(off @ np.linalg.solve(error @ error.T, off) < chi2.ppf(0.9, 6))
    assert 0.82 < inside / 80 < 0.97


def with_keyframes(graph: SolvedGraph) -> tuple[Atlas, list[int]]:
    """Return a path of one submap with two frames after each keyframe, whose poses the graph has moved."""
    atlas, keyframes = Atlas(), list[int]()
    atlas.begin_submap()
    edges = measured(np.random.default_rng(1))
    for k in range(NODES):
        hop = RelativePose.hop(edges[k - 1].T_a_b, np.diag(NOISE**2), SAME)
        atlas.set_keyframes([*atlas.keyframe_poses.last, TRUTH[k]], hop)
        keyframes.append(len(atlas.places))
        for _ in range(3):
            atlas.place_frame(TRUTH[k])
    atlas.refined, atlas.graph = {0: list(graph.T_world_node)}, graph
    return atlas, keyframes


def test_a_direction_that_an_edge_does_not_hold_is_no_failure() -> None:
    """Information of a loop that was turned into another frame can be negative by rounding in such a direction."""
    edges = measured(np.random.default_rng(3))
    graph = solved(edges)
    loose = graph.information.copy()
    loose[-1] -= np.diag([0, 0, 0, 0, 0, 1.0]) * (loose[-1, 5, 5] + 1e-4)
    error = GraphErrors(replace(graph, information=loose)).of(NODES - 1)
    assert np.isfinite(error).all()
    firm = GraphErrors(graph).of(NODES - 1)
    assert np.trace(error @ error.T) == pytest.approx(np.trace(firm @ firm.T), rel=0.5)


def test_a_frame_between_keyframes_shares_the_errors_of_both() -> None:
    graph = solved(measured(np.random.default_rng(2)))
    atlas, keyframes = with_keyframes(graph)
    tensors = path_errors(atlas, keyframes, Edges()) | {"T_world_camera": torch.from_numpy(atlas.T_world_camera())}
    path = PathCovariance.of(tensors)
    assert path is not None
    errors = GraphErrors(graph)
    before, after = errors.of(9), errors.of(10)
    assert np.allclose(path.of_frame(27), before @ before.T, rtol=1e-9)
    assert np.allclose(path.T_world_camera[27], graph.T_world_node[9])
    shared, A = (2 * before + after) / 3, se3.adjoint(path.T_world_camera[28])
    own = A @ (np.diag(NOISE**2 + SAME**2)) @ A.T
    assert np.allclose(path.of_frame(28), shared @ shared.T + own, rtol=1e-9)
    between = path.between(0, 27)
    assert np.allclose(between, se3.adjoint(se3.inverse(graph.T_world_node[0])) @ before @ before.T, atol=1e-15)


def test_a_checkpoint_keeps_the_graph() -> None:
    graph = solved(measured(np.random.default_rng(3)))
    atlas, keyframes = with_keyframes(graph)
    tensors = path_errors(atlas, keyframes, Edges())
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    found = graph_errors.read(arrays)
    assert found is not None and found.fixed == 1
    assert np.array_equal(GraphErrors(found).of(12), GraphErrors(graph).of(12))
    assert graph_errors.read({}) is None


def test_a_chain_alone_has_the_errors_of_its_hops() -> None:
    atlas, keyframes = with_keyframes(solved(measured(np.random.default_rng(4))))
    atlas.graph, atlas.refined = None, {}
    path = PathCovariance.of_keyframes(atlas, Edges())
    nodes = KeyframeNodes.of(path, {0: keyframes})
    edges = nodes.edges()
    assert nodes.solved(solve(nodes.T_world_keyframe, edges), edges, np.zeros((len(edges), 6, 11))) is None
    assert replace(path, graph=None).of_keyframe(0, 5).trace() > 0


WALL = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 21), np.linspace(-0.4, 0.4, 15), [1.0]), -1).reshape(-1, 3)
SEEN = WALL * (1.5 + 0.8 * WALL[:, :1] - 0.5 * np.abs(WALL[:, 1:2]))
"""What each camera sees: two walls that meet."""
ALL = np.full(4, CALIBRATION)


def test_what_is_measured_of_a_camera_has_its_own_error() -> None:
    camera = Camera(320, 240, 256.0, 256.0, 159.5, 119.5)
    assert np.array_equal(calibration_std(InputConfig(), camera), ALL)
    assert calibration_std(InputConfig(sensor="rendered"), camera) is None
    measured = InputConfig(calibrate="0,0,0,0.1,0.1,0.1,0.02,0,0,0,0,0.001,0.002,0.003,0.1,0.1")
    assert np.allclose(calibration_std(measured, camera), [CALIBRATION, 0.001, 0.002 * 1.25, 0.003 * 1.25])


def test_an_error_of_time_is_that_of_a_later_path() -> None:
    """Motions of the same screw in each step are the same at another time; motions that grow are not."""
    edges = [RelativePose(a, b, se3.inverse(TRUTH[a]) @ TRUTH[b], np.eye(6), kind, bias=SAME) for a, b, kind in pairs()]
    step = se3.log(se3.inverse(TRUTH[0]) @ TRUTH[1])
    shared = shared_errors(edges, np.tile(step, (NODES, 1)), [SEEN] * NODES, ALL)
    assert np.array_equal(shared[:, :, :6], np.tile(np.diag(SAME), (len(edges), 1, 1)))
    assert np.allclose(shared[:, :, 10], 0.0, atol=1e-12), "motions of the same speed are the same at another time"
    assert not shared_errors(edges, np.tile(step, (NODES, 1)), [], None)[:, :, 6:].any(), "renders have no such errors"
    faster = step * np.linspace(1.0, 2.0, NODES)[:, None]
    late = shared_errors(edges, faster, [SEEN] * NODES, ALL)[:, :, 10]
    for edge, found in list(zip(edges, late, strict=True))[::9]:
        T_a, T_b = (TRUTH[n] @ se3.exp(1e-3 * faster[n]) for n in (edge.a, edge.b))
        true = se3.log(se3.inverse(T_a) @ T_b @ se3.inverse(edge.T_a_b)) / 1e-3
        assert np.allclose(found, STAMP * true, atol=1e-3 * np.abs(true).max())


@pytest.mark.parametrize("motion", [[0.2, 0.1, -0.1, 0, 0, 0], [0.1, 0, 0.05, 0.1, -0.2, 0.1], [0, 0, 0, 0, 0.2, 0]])
def test_errors_of_calibration_are_those_of_points_that_a_wrong_camera_sees(motion: list[float]) -> None:
    """Points are read with a wrong camera in both images; the motion that fits them best (Gauss-Newton on residuals
    across and along the rays) moves as stated."""
    T, step = se3.exp(np.array(motion)), 1e-3
    found = moved_by_camera(T, SEEN)
    wrong = [np.diag([1 + step] * 3), np.diag([1 + step, 1 + step, 1.0]), np.eye(3), np.eye(3)]
    wrong[2], wrong[3] = (
        wrong[2] + step * np.outer([1, 0, 0], [0, 0, 1]),
        wrong[3] + step * np.outer([0, 1, 0], [0, 0, 1]),
    )
    in_a = SEEN @ T[:3, :3].T + T[:3, 3]
    for parameter, S in enumerate(wrong):
        a, b = in_a @ S.T, SEEN @ S.T

        def residuals(xi: Array, a: Array = a, b: Array = b) -> Array:
            fitted = se3.exp(xi) @ T
            apart = a - (b @ fitted[:3, :3].T + fitted[:3, 3])
            return (apart / in_a[:, 2:] ** np.array([1.0, 1.0, 2.0])).ravel()

        true = least_squares(residuals, np.zeros(6), x_scale=1e-3, xtol=1e-14, ftol=1e-14).x / step
        assert np.allclose(found[:, parameter], true, atol=0.01 * np.abs(true).max() + 1e-5)
    if not any(motion[3:]):
        assert np.allclose(found[:, 0], motion, atol=1e-9), "a longer metre: a longer way"


@pytest.mark.parametrize("width", [32, 64, 320])
def test_an_image_shows_points_at_every_size_and_only_a_few(width: int) -> None:
    height = width * 3 // 4
    gray, depth_m = np.full((height, width), 0.5, np.float32), np.full((height, width), 2.0, np.float32)
    whole = Pyramid.of(gray, depth_m, Camera(width, height, width, width, width / 2, height / 2))
    for image in (whole, whole.finest()):
        assert 4 <= len(image.points) < 80 * 80 and np.allclose(image.points[:, 2], 2.0)
