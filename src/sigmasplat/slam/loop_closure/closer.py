"""Close loops: find candidate submaps, register them, solve the pose graph, and move the anchors."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import Config, LoopConfig
from sigmasplat.errors import ConfigError
from sigmasplat.model import se3
from sigmasplat.model.atlas import Atlas
from sigmasplat.model.field import COLUMNS
from sigmasplat.model.submap import Submap, SubmapStore
from sigmasplat.render.view import View
from sigmasplat.slam.features import Extractor
from sigmasplat.slam.loop_closure.candidates import (
    Candidate,
    SubmapDescriptor,
    SubmapPair,
    find_candidates,
    find_nearby,
    opacity_ratio,
    pairs_to_register,
)
from sigmasplat.slam.loop_closure.descriptors import Descriptor, OrientationGrid
from sigmasplat.slam.loop_closure.neighbourhood import MOST_FREE, Incidence, Neighbourhood, numbered
from sigmasplat.slam.loop_closure.pose_graph import Edge, LoopVerdict, PoseGraph, most_chi2
from sigmasplat.slam.loop_closure.registration import Registrar, Registration
from sigmasplat.slam.predicted_submaps import PredictedSubmaps
from sigmasplat.types import Matrix, Slices, completed

RIGID = np.diag(np.repeat([1e-4, 1e-5], 3) ** -2.0)
"""Information of the edge to a submap of an earlier session: 0.1 mm and 0.0006°. Its map is finished, and poses in its
world stay valid: a loop that disagrees moves the submaps of the new session."""

GROWTH = 1.25
"""A pose graph that is not larger than the largest part is solved as a whole when it has grown by this factor."""
WIDER = 3
"""Factor from one part of the pose graph to the next larger one, while a new loop disagrees."""
WIDEST = WIDER**2
"""Factor from the smallest part to the largest one: it bounds the time of a cut, however long the run is."""


@dataclass(frozen=True, eq=False, slots=True)
class Loop:
    """A pair of submaps that was tried as a loop, and the result.

    query, database: submaps; query_frame, database_frame: the frames of their most similar keyframes; similarity,
    gated: of these keyframes (VarSplat §4); residual, overlap, localised: of the registration; translation_m,
    rotation_deg: the difference between T_query_database [4, 4] and the poses before; chi2, weight: verdict of the pose
    graph; accepted: whether the loop is used.
    """

    query: int
    database: int
    query_frame: int
    database_frame: int
    similarity: float
    gated: float
    accepted: bool
    reason: str
    residual: float
    overlap: float
    localised: int
    translation_m: float
    rotation_deg: float
    T_query_database: Matrix
    chi2: float = float("nan")
    weight: float = float("nan")

    @property
    def is_edge(self) -> bool:
        """Return whether the registration succeeded: the loop is an edge of the pose graph, accepted by it or not."""
        return isfinite(self.chi2) or self.accepted

    def record(self) -> dict[str, Any]:
        """Return plain values, T_query_database as 4 rows."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__} | {
            "T_query_database": self.T_query_database.tolist()
        }


def make_descriptor(config: LoopConfig) -> Descriptor:
    """Make the descriptor of keyframes. Raises ConfigError if NetVLAD has no weights file or cannot load it."""
    if config.descriptor == "grid":
        return OrientationGrid()
    if lacks_weights(config):
        return OrientationGrid()
    if not config.weights:
        raise ConfigError("loops.descriptor=netvlad needs a file of weights: --set loops.weights=FILE")
    from sigmasplat.slam.loop_closure.netvlad import NetVlad, NetVladWeights

    return NetVlad(NetVladWeights.load(config.weights))


def lacks_weights(config: LoopConfig) -> bool:
    """Return whether the built-in descriptor replaces NetVLAD because no file of weights is set."""
    return config.descriptor == "netvlad-or-grid" and not config.weights


@dataclass(eq=False)
class OwedSearch:
    """The search for the loops of a finished submap that is not complete: the submap, the descriptors [D] of its
    keyframes, and the slices of `LoopCloser.closing` that are done."""

    submap: int
    descriptors: list[NDArray[np.float32]]
    slices: int = 0


@dataclass(eq=False)
class LoopCloser:
    """Keeps the descriptors of finished submaps and all edges between them. Only this class moves anchors.

    edges: trusted ones, such as odometry, and registered loops; loop_rows: for each edge its row in `loops`, -1 for a
    trusted one. solved: the number of submaps when the whole pose graph was last solved. In between, and in a graph
    that is larger than the largest part, loops move only the submaps near them in the graph (`Neighbourhood`).
    owed: the searches that are not complete, the oldest first.
    """

    config: Config
    store: SubmapStore
    extractor: Extractor | None = None
    descriptors: list[SubmapDescriptor] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    loop_rows: list[int] = field(default_factory=list)
    loops: list[Loop] = field(default_factory=list)
    solved: int = 0
    owed: list[OwedSearch] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.predicted = PredictedSubmaps(self.config, self.store)
        self.graph = Incidence(self.edges)

    def connect(self, a: int, b: int, T_a_b: Matrix, information: Matrix) -> None:
        """Add a trusted edge between two submaps, such as odometry to the next one or a relocalisation: T_a_b [4, 4],
        and the information [6, 6] of its left twist (m, rad)."""
        self._add(Edge(a, b, T_a_b, information, loop=False), -1)

    def _add(self, edge: Edge, loop_row: int) -> None:
        self.edges.append(edge)
        self.loop_rows.append(loop_row)

    def add_finished(self, submap: Submap, descriptors: Sequence[NDArray[np.float32]], T_first_submap: Matrix) -> None:
        """Add a submap of an earlier session: loops to it are tried, but it stays where it is relative to the first
        submap.

        descriptors [D]: one per keyframe, none if loops are not closed. T_first_submap [4, 4]: its pose in submap 0.
        """
        if descriptors:
            self.descriptors.append(self._described(submap, descriptors))
        if submap.index:
            self.connect(0, submap.index, T_first_submap, RIGID)

    @property
    def believed(self) -> list[Edge]:
        """Return the trusted edges and the accepted loops."""
        known = zip(self.edges, self.loop_rows, strict=True)
        return [edge for edge, row in known if row < 0 or self.loops[row].accepted]

    def _described(self, submap: Submap, descriptors: Sequence[NDArray[np.float32]]) -> SubmapDescriptor:
        reach_m = float(np.linalg.norm(submap.T_submap_camera[:, :3, 3], axis=1).max())
        return SubmapDescriptor(submap.index, np.stack(descriptors), self.opacity_ratio(submap), reach_m)

    def opacity_ratio(self, submap: Submap) -> float:
        """Return the variance-weighted opacity ratio of a submap (VarSplat §4)."""
        c, rows = self.config.loops, submap.field.params
        if c.uncertainty and c.variance == "predicted":
            rows = self.predicted.rows(submap.index)
        log_variances = rows[:, COLUMNS["log_variances"]].numpy()
        return opacity_ratio(submap.field.opacities.numpy(), log_variances, c.tau, c.weight_max)

    def submap_finished(
        self, submap: Submap, descriptors: Sequence[NDArray[np.float32]], atlas: Atlas, view: View
    ) -> list[Loop]:
        """Look for loops from a finished submap to earlier ones; if one is found, correct the anchors.

        descriptors [D]: one per keyframe, in order, of unit norm or zero. Returns the pairs that were tried, each with
        the latest verdict.
        """
        return completed(self.closing(submap, descriptors, atlas, view))

    def closing(
        self, submap: Submap, descriptors: Sequence[NDArray[np.float32]], atlas: Atlas, view: View
    ) -> Slices[list[Loop]]:
        """Look for loops as `submap_finished` does, in slices of one alignment.

        Nothing changes before the last slice: a search that was begun can be made again from its first slice, as long
        as the anchors stay.
        """
        if not self.config.loops.close or not descriptors:
            return []
        query = self._described(submap, descriptors)
        tried = list[tuple[Loop, Edge | None]]()
        for pair in self._pairs(query, atlas):
            yield
            tried.append((yield from self._try(pair, submap, atlas, view)))
        self.descriptors.append(query)
        known = len(self.edges)
        for loop, edge in tried:
            self.loops.append(loop)
            if edge is not None:
                self._add(edge, len(self.loops) - 1)
        if len(self.edges) > known:
            self._correct_at(atlas, submap.index, known)
        return self.loops[len(self.loops) - len(tried) :]

    def _pairs(self, query: SubmapDescriptor, atlas: Atlas) -> list[SubmapPair]:
        """Choose the earlier submaps to register with: first similar ones, then those near by the current poses."""
        c = self.config.loops
        database = [d for d in self.descriptors if atlas.components[d.index] == atlas.components[query.index]]
        keyframes, most = self.config.registration.keyframes, c.most or None
        candidates = find_candidates(
            query, database, c.min_similarity, c.min_interval, c.similarity_floor, c.uncertainty, most
        )
        pairs = pairs_to_register(candidates, query, database, keyframes, most)
        if c.near_m:
            around = self._around(query, database, atlas)
            poses = {other.index: atlas.T_world_keyframe(other.index) for other in (query, *around)}
            near_rad, known = np.deg2rad(c.near_deg), {pair.best.database_submap for pair in pairs}
            # Of the nearest 2n, at most n are known already.
            twice = None if most is None else 2 * most
            near = find_nearby(query, around, poses, c.near_m, near_rad, c.min_interval, keyframes, twice)
            pairs += [pair for pair in near if pair.best.database_submap not in known]
        return pairs[:most]

    def _around(
        self, query: SubmapDescriptor, database: Sequence[SubmapDescriptor], atlas: Atlas
    ) -> list[SubmapDescriptor]:
        """Return the submaps that may have a keyframe nearer than `near_m` to one of the query's."""
        if not database:
            return []
        centres = np.array([atlas.anchors[other.index][:3, 3] for other in database])
        apart_m = np.linalg.norm(centres - atlas.anchors[query.index][:3, 3], axis=1)
        reach_m = query.reach_m + np.array([other.reach_m for other in database])
        return [database[row] for row in np.flatnonzero(apart_m <= self.config.loops.near_m + reach_m).tolist()]

    def _try(self, pair: SubmapPair, a: Submap, atlas: Atlas, view: View) -> Slices[tuple[Loop, Edge | None]]:
        """Register a pair in slices, with `a` as the query; return the result, and its edge if it was accepted."""
        b = self.store.load(pair.best.database_submap)
        known = se3.inverse(atlas.anchors[a.index]) @ atlas.anchors[b.index]
        registrar = Registrar(self.config, self.store, view, self.extractor, self.predicted)
        found = yield from registrar.register(pair, a, b, known)
        edge = Edge(a.index, b.index, found.T_a_b, found.information, loop=True) if found.accepted else None
        return described(pair.best, a, b, found, known), edge

    def solve_all(self, atlas: Atlas) -> None:
        """Solve the pose graph of each component as a whole; call it once, after the last submap."""
        for component in sorted(set(atlas.components)):
            if len(atlas.members(component)) > MOST_FREE:
                self._correct(atlas, component)

    def _correct_at(self, atlas: Atlas, submap: int, first: int) -> None:
        """Solve the pose graph as far as the new edges of a submap, from row `first` on, require it.

        Loops that agree with the poses move only the submaps near them. If one disagrees, larger parts are solved until
        all agree, or up to the largest part. A larger graph is solved as a whole only at the end (`solve_all`). Each
        part starts at the solutions of earlier ones.
        """
        component = atlas.components[submap]
        largest, members = WIDEST * MOST_FREE, len(atlas.members(component))
        if GROWTH * self.solved < members <= largest:
            self._correct(atlas, component)
            return
        new = [row for row in range(first, len(self.edges)) if self.edges[row].loop]
        size = WIDER * MOST_FREE if self._wrong(atlas, new) else MOST_FREE
        while not self._correct(atlas, component, submap, size) and size < largest and self._wrong(atlas, new):
            size *= WIDER

    def _wrong(self, atlas: Atlas, rows: Sequence[int]) -> bool:
        """Return whether any of these edges disagrees with the poses."""
        edges = [self.edges[row] for row in rows]
        nodes = sorted({end for edge in edges for end in (edge.a, edge.b)})
        chi2 = PoseGraph(len(nodes), numbered(edges, nodes)).chi2(np.stack([atlas.anchors[node] for node in nodes]))
        return bool((chi2 > most_chi2()).any())

    def _is_rejected(self, loop_row: int) -> bool:
        """Return whether a pose graph that was solved before has rejected the loop of an edge."""
        return loop_row >= 0 and isfinite(self.loops[loop_row].chi2) and not self.loops[loop_row].accepted

    def _correct(self, atlas: Atlas, component: int, centre: int | None = None, most_free: int = MOST_FREE) -> bool:
        """Solve the pose graph of a component, move its anchors, and update the verdict on its registered loops; return
        whether the whole graph was solved.

        centre: a submap; only the `most_free` submaps nearest to it in the graph are moved. Without it, or if there are
        not more, the whole graph is solved.
        """
        members = atlas.members(component)
        whole = centre is None or len(members) <= most_free
        if centre is None or whole:
            part = Neighbourhood.whole(members, self.edges)
        else:
            part = Neighbourhood.around(centre, self.graph, members[0], most_free)
        small = len(members) <= MOST_FREE
        rejected = [] if small else [self._is_rejected(self.loop_rows[edge]) for edge in part.edges]
        solution = part.solve(atlas.anchors, self.edges, rejected)
        for submap, T_world_submap in zip(part.nodes, solution.T_world_node, strict=True):
            atlas.anchors[submap] = T_world_submap
        tested = [row for row in (self.loop_rows[edge] for edge in part.edges) if row >= 0]
        for row, verdict in zip(tested, solution.verdicts, strict=True):
            self.loops[row] = judged(self.loops[row], verdict)
        if whole:
            self.solved = max(self.solved, len(members))
        return whole


def described(best: Candidate, a: Submap, b: Submap, found: Registration, known: Matrix) -> Loop:
    """Return the loop record of a registration of submaps a and b; best: their most similar keyframes; known: T_a_b
    [4, 4] before it."""
    seen_from = b.T_submap_camera[best.database_keyframe]
    moved = se3.inverse(known @ seen_from) @ found.T_a_b @ seen_from
    return Loop(
        a.index, b.index, a.frames[best.query_keyframe], b.frames[best.database_keyframe], best.similarity,
        best.gated, found.accepted, found.reason, found.residual, found.overlap, found.localised,
        float(np.linalg.norm(moved[:3, 3])), float(np.rad2deg(se3.rotation_angle(moved[:3, :3]))), found.T_a_b,
    )  # fmt: skip


def judged(loop: Loop, verdict: LoopVerdict) -> Loop:
    """Return a registered loop with the pose graph's verdict on it."""
    reason = "accepted" if verdict.accepted else f"the pose graph disagrees (χ² {verdict.chi2:.0f})"
    return replace(loop, accepted=verdict.accepted, reason=reason, chi2=verdict.chi2, weight=verdict.weight)
