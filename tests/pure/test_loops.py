"""Closing loops with the registration made up: who is tried, what is remembered, which anchors move."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from paper_settings import LoopConfig, paper_settings
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.errors import ConfigError
from sigmasplat.graph import closer
from sigmasplat.graph.candidates import SubmapPair
from sigmasplat.graph.closer import LoopCloser, Neighbourhood, make_descriptor
from sigmasplat.graph.registration import Registration
from sigmasplat.tracking.descriptors import OrientationGrid
from sigmasplat.types import Task, completed

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
STEP = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.0]))
SURE = np.diag([1e6] * 6)


class Registered:
    """Stands in the place of `Registrar`: submaps are where `truth` says, or where `lies` say."""

    truth: list[np.ndarray]
    lies: dict[tuple[int, int], np.ndarray]

    def __init__(self, *_: object) -> None:
        pass

    def registered(self, pair: SubmapPair, a: Submap, b: Submap, known: np.ndarray) -> Registration:
        assert (a.index, b.index) == (pair.best.query_submap, pair.best.database_submap)
        T_a_b = self.lies.get((a.index, b.index), se3.inverse(self.truth[a.index]) @ self.truth[b.index])
        return Registration(T_a_b, SURE, 0.1, 4, 0.9, True, "accepted")

    def register(self, pair: SubmapPair, a: Submap, b: Submap, known: np.ndarray) -> Task[Registration]:
        yield
        return self.registered(pair, a, b, known)


def make_closer(
    monkeypatch: pytest.MonkeyPatch, lies: dict[tuple[int, int], np.ndarray], **changes: object
) -> LoopCloser:
    """A closer whose registrations are made up; submaps lie a metre apart, each says odometry 2 cm too far."""
    monkeypatch.setattr(closer, "Registrar", Registered)
    Registered.truth = [np.linalg.matrix_power(STEP, k % 4) for k in range(9)]
    Registered.lies = lies
    usual = {"min_interval": 2, "min_similarity": 1.0, "similarity_floor": 0.0}
    config = paper_settings(loops=LoopConfig(**(usual | changes)))
    return LoopCloser(config, MemoryStore())


def walked(closer: LoopCloser, alike: bool = True, atlas: Atlas | None = None) -> Atlas:
    """Finish four submaps with two keyframes each, in a new component; the last looks like the first, and where asked
    it is tried."""
    atlas, drift = atlas or Atlas(), se3.exp(np.array([1.02, 0, 0, 0, 0, 0.0]))
    first = len(atlas.anchors)
    for k, degrees in enumerate([0.0, 60.0, 120.0, 0.0 if alike else 180.0]):
        if k:
            closer.edges.append(RelativePose(first + k - 1, first + k, drift, np.diag([1e4] * 6)))
        atlas.begin_submap(drift if k else None)
        finished(closer, atlas, degrees)
    return atlas


def finished(closer: LoopCloser, atlas: Atlas, degrees: float, T_submap_last: np.ndarray | None = None) -> None:
    """Finish the last submap, whose two keyframes look into directions of the plane; the last one may be elsewhere."""
    s, poses = len(atlas.anchors) - 1, [np.eye(4), np.eye(4) if T_submap_last is None else T_submap_last]
    atlas.keyframe_poses.newest = poses
    field = GaussianField.from_values(torch.zeros(3, 3), torch.ones(3), torch.zeros(3, 3))
    submap = Submap(s, field, (2 * s, 2 * s + 1), np.stack(poses), CAMERA)
    picture = Picture(np.zeros((3, 4, 3), np.uint8), np.ones((3, 4), np.float32))
    closer.store.save(submap, [picture, picture])
    looks = [np.array([np.cos(a), np.sin(a)], np.float32) for a in np.deg2rad([degrees, degrees + 20.0])]
    completed(closer.closing(submap, looks, atlas, None))  # type: ignore[arg-type]


def test_a_true_loop_takes_the_drift_out_and_leaves_the_first_anchor(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_closer(monkeypatch, {})
    atlas = walked(made)
    (loop,) = made.loops
    assert (loop.query, loop.database, loop.query_frame, loop.database_frame) == (3, 0, 6, 0)
    assert loop.accepted and loop.chi2 < 16.8 and loop.translation_m == pytest.approx(0.06)
    assert np.array_equal(atlas.anchors[0], np.eye(4))
    assert atlas.anchors[3][0, 3] == pytest.approx(3.0, abs=2e-3)
    assert atlas.anchors[1][0, 3] == pytest.approx(1.0, abs=2e-3)


def test_a_gross_lie_is_registered_refused_by_the_graph_and_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_closer(monkeypatch, {(3, 0): se3.exp(np.array([5.0, 2.0, 0, 0, 0, 1.0]))})
    atlas = walked(made)
    (loop,) = made.loops
    assert not loop.accepted
    assert "pose graph disagrees" in loop.reason
    assert [T[0, 3] for T in atlas.anchors] == pytest.approx([0.0, 1.02, 2.04, 3.06])
    assert loop.record()["accepted"] is False


def test_places_that_do_not_look_alike_are_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_closer(monkeypatch, {}, similarity_floor=0.5)
    atlas = walked(made, alike=False)
    assert not made.loops
    assert atlas.anchors[3][0, 3] == pytest.approx(3.06)


@pytest.mark.parametrize(("ends_at_m", "tried"), [(2.6, True), (2.5, False)])
def test_a_submap_is_near_where_its_keyframes_are_not_where_it_begins(
    monkeypatch: pytest.MonkeyPatch, ends_at_m: float, tried: bool
) -> None:
    """The first submap ends near the fourth one, which is 3.06 m from where the first one begins."""
    made, atlas = make_closer(monkeypatch, {}, near_m=0.5, min_interval=3), Atlas()
    drift = se3.exp(np.array([1.02, 0, 0, 0, 0, 0.0]))
    for k in range(4):
        if k:
            made.edges.append(RelativePose(k - 1, k, drift, np.diag([1e4] * 6)))
        atlas.begin_submap(drift if k else None)
        finished(made, atlas, 60.0 * k, None if k else se3.exp(np.array([ends_at_m, 0, 0, 0, 0, 0.0])))
    assert [(loop.query, loop.database, loop.database_frame) for loop in made.loops] == [(3, 0, 1)] * tried


def test_switched_off_nothing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_closer(monkeypatch, {}, close=False)
    walked(made)
    assert not made.loops
    assert len(made.edges) == 3


def test_a_refused_registration_makes_no_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_closer(monkeypatch, {})
    plain = Registered.registered
    monkeypatch.setattr(
        Registered, "registered", lambda *a: replace(plain(*a), accepted=False, reason="overlap 0.05 is below 0.2")
    )
    atlas = walked(made)
    assert not any(edge.loop for edge in made.edges)
    assert [loop.reason for loop in made.loops] == ["overlap 0.05 is below 0.2"]
    assert np.isnan(made.loops[0].chi2)
    assert atlas.anchors[3][0, 3] == pytest.approx(3.06)


def test_each_component_has_its_own_pose_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both look the same, but their poses cannot be compared: loops are tried and anchors move inside one only."""
    made = make_closer(monkeypatch, {})
    atlas = walked(made)
    world = [T.copy() for T in atlas.anchors]
    walked(made, atlas=atlas)
    assert [(loop.query, loop.database) for loop in made.loops] == [(3, 0), (7, 4)]
    assert all(loop.accepted and loop.chi2 < 16.8 for loop in made.loops)
    assert all(np.array_equal(a, b) for a, b in zip(atlas.anchors, world, strict=False))
    assert np.array_equal(atlas.anchors[4], np.eye(4)), "the first submap of a component is its frame"
    for s, x_m in ((5, 1.0), (7, 3.0)):
        assert atlas.anchors[s][0, 3] == pytest.approx(x_m, abs=2e-3)


def test_components_that_have_joined_share_a_pose_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The link is 5 cm off; a later loop from the joined part to the world corrects it, and old loops stay valid."""
    made = make_closer(monkeypatch, {})
    atlas = walked(made, alike=False)
    walked(made, atlas=atlas)
    link = se3.exp(np.array([0.05, 0, 0, 0, 0, 0.0]))
    atlas.join(0, 4, link)
    made.edges.append(RelativePose(0, 4, link, np.diag([1e3] * 6)))
    drift = se3.exp(np.array([-3.0, 0, 0, 0, 0, 0.0]))
    made.edges.append(RelativePose(7, 8, drift, np.diag([1e4] * 6)))
    atlas.begin_submap(drift, 7)
    finished(made, atlas, 60.0)
    tried = {(loop.query, loop.database): loop for loop in made.loops}
    assert (8, 1) in tried and tried[7, 4].accepted
    assert np.array_equal(atlas.anchors[0], np.eye(4))
    assert {loop.query for loop in made.loops if np.isfinite(loop.chi2)} == {7, 8}
    assert abs(atlas.anchors[4][0, 3]) < 0.03


def solved_parts(monkeypatch: pytest.MonkeyPatch, most_free: int) -> dict[int, list[int | None]]:
    """Let parts of the graph have `most_free` nodes; note by submap the sizes of the parts that were solved, None for
    the whole graph."""
    parts, around, whole = dict[int, list[int | None]](), Neighbourhood.around, Neighbourhood.whole

    def part_of(centre: int, ends: np.ndarray, always_fixed: int, size: int) -> Neighbourhood:
        parts.setdefault(centre, []).append(size)
        return around(centre, ends, always_fixed, size)

    def all_of(nodes: list[int], edges: list[RelativePose]) -> Neighbourhood:
        parts.setdefault(nodes[-1], []).append(None)
        return whole(nodes, edges)

    monkeypatch.setattr(Neighbourhood, "around", part_of)
    monkeypatch.setattr(Neighbourhood, "whole", all_of)
    monkeypatch.setattr(closer, "MOST_FREE", most_free)
    return parts


def there_and_back(made: LoopCloser, last_m: float) -> Atlas:
    """The camera walks 12 m and turns back. Odometry is wrong by 0.5 mm at each step, and at the last by `last_m`."""
    places = [*range(13), *range(11, -1, -1)]
    Registered.truth = [se3.exp(np.array([x, 0, 0, 0, 0, 0.0])) for x in places]
    atlas = Atlas()
    for k, x in enumerate(places):
        step = se3.inverse(Registered.truth[k - 1]) @ Registered.truth[k]
        step[0, 3] += last_m if k == 24 else 5e-4
        if k:
            made.edges.append(RelativePose(k - 1, k, step, np.diag([1e4] * 6)))
        atlas.begin_submap(step if k else None)
        before = np.stack(atlas.anchors)
        finished(made, atlas, 25.0 * x)
        moved = int((np.abs(np.stack(atlas.anchors) - before).max((1, 2)) > 0).sum())
        assert k in (13, 17, 22, 24) or moved <= 4, "only those near it move"
        assert k != 24 or moved > 4, "those farther away move too"
    return atlas


def test_in_a_long_run_the_whole_graph_is_solved_if_it_has_grown(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop that agrees moves the submaps near it, and one that disagrees moves more of them."""
    made, parts = make_closer(monkeypatch, {}), solved_parts(monkeypatch, 4)
    atlas = there_and_back(made, 0.03)
    assert all(loop.accepted for loop in made.loops)
    near = {k: [4] for k in (14, 15, 16, 18, 19, 20, 21, 23)}
    assert parts == near | {13: [None], 17: [None], 22: [None], 24: [12]}, "first, 1.25 times, 1.25 times, 3 cm"
    made.solve_all(atlas)
    assert parts[24] == [12, None]
    np.testing.assert_allclose(
        [T[0, 3] for T in atlas.anchors[13:]], [atlas.anchors[24 - s][0, 3] for s in range(13, 25)], atol=2e-3
    )


def test_a_loop_that_still_disagrees_moves_ever_more_submaps_up_to_the_largest_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A false loop is rejected by every part of the graph: the largest one is the last."""
    lie = {(24, 0): se3.exp(np.array([4.0, 0, 0, 0, 0, 0.0]))}
    made, parts = make_closer(monkeypatch, lie), solved_parts(monkeypatch, 2)
    Registered.truth = [se3.exp(np.array([x, 0, 0, 0, 0, 0.0])) for x in [*range(13), *range(11, -1, -1)]]
    atlas = Atlas()
    for k in range(25):
        step = se3.inverse(Registered.truth[k - 1]) @ Registered.truth[k] if k else None
        if step is not None:
            made.edges.append(RelativePose(k - 1, k, step, np.diag([1e4] * 6)))
        atlas.begin_submap(step)
        finished(made, atlas, 25.0 * Registered.truth[k][0, 3])
    assert parts[24] == [6, 18], "not the whole graph of 25"
    assert not any(None in sizes for k, sizes in parts.items() if k >= 18), "larger than the largest part of 18"
    assert any(None in sizes for k, sizes in parts.items() if k < 18)
    assert [(loop.query, loop.database) for loop in made.loops if not loop.accepted] == [(24, 0)]
    np.testing.assert_allclose(np.stack(atlas.anchors), np.stack(Registered.truth), atol=1e-6)
    made.solve_all(atlas)
    assert parts[24] == [6, 18, None], "the end solves the whole graph"


def test_the_descriptor_by_its_name() -> None:
    assert isinstance(make_descriptor(LoopConfig()), OrientationGrid)
    assert isinstance(make_descriptor(LoopConfig(descriptor="netvlad-or-grid")), OrientationGrid)
    with pytest.raises(ConfigError, match="No such file"):
        make_descriptor(LoopConfig(descriptor="netvlad-or-grid", weights="absent.pth"))
