"""Close loops: find candidate submaps, register them, solve the pose graph, and move the anchors."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import Config, LoopConfig
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.field import COLUMNS
from sigmasplat.data.poses import Column
from sigmasplat.data.relative_pose import Edges, RelativePose
from sigmasplat.data.submap import Submap, SubmapStore
from sigmasplat.errors import ConfigError
from sigmasplat.graph.candidates import (
    DescribedSubmaps,
    SubmapDescriptor,
    SubmapPair,
    find_candidates,
    find_nearby,
    opacity_ratio,
    pairs_to_register,
)
from sigmasplat.graph.loops import Loop, Loops, described
from sigmasplat.graph.pose_graph import LARGE, PoseGraph, PoseGraphSolution, most_chi2, optimise
from sigmasplat.graph.registration import Registrar
from sigmasplat.render.view import View
from sigmasplat.tracking.descriptors import Descriptor, OrientationGrid
from sigmasplat.tracking.features import Extractor
from sigmasplat.types import Matrix, Task

RIGID = np.diag(np.repeat([1e-4, 1e-5], 3) ** -2.0)
"""Information of the edge to a submap of an earlier session: 0.1 mm and 0.0006°. Its map is finished, and poses in its
world stay valid: a loop that disagrees moves the submaps of the new session."""

GROWTH = 1.25
"""A pose graph that is not larger than the largest part is solved as a whole when it has grown by this factor."""
WIDER = 3
"""Factor from one part of the pose graph to the next larger one, while a new loop disagrees."""
WIDEST = WIDER**2
"""Factor from the smallest part to the largest one: it bounds the time of a cut, however long the run is."""


def make_descriptor(config: LoopConfig) -> Descriptor:
    """Make the descriptor of keyframes. Raises ConfigError if NetVLAD has no weights file or cannot load it."""
    if config.descriptor == "grid" or _lacks_weights(config):
        return OrientationGrid()
    if not config.weights:
        raise ConfigError(f"loops.descriptor=netvlad needs a file of weights; {NETVLAD}")
    from sigmasplat.graph.netvlad import NetVlad, NetVladWeights

    return NetVlad(NetVladWeights.load(config.weights))


NETVLAD = (
    "to use NetVLAD: sigmasplat download netvlad, then --set loops.weights=data/netvlad/VGG16-NetVLAD-Pitts30K.mat"
)


def lacks_netvlad(config: Config) -> bool:
    """Return whether the built-in descriptor replaces NetVLAD because no file of weights is set."""
    used = config.loops.close or config.mapping.covisibility == "descriptor"
    return used and _lacks_weights(config.loops)


def _lacks_weights(config: LoopConfig) -> bool:
    return config.descriptor == "netvlad-or-grid" and not config.weights


MOST_FREE = LARGE
"""A larger graph is solved in parts of this many nodes, each directly; a smaller one is always solved as a whole."""


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """A part of a graph. nodes: their numbers in the graph, the fixed ones first; fixed: how many these are; edges:
    rows of the graph's edges with at least one free end."""

    nodes: tuple[int, ...]
    fixed: int
    edges: tuple[int, ...]

    @staticmethod
    def whole(nodes: Sequence[int], edges: Sequence[RelativePose]) -> "Neighbourhood":
        """Return the whole graph of some nodes, the first of them fixed."""
        inside = set(nodes)
        return Neighbourhood(tuple(nodes), 1, tuple(row for row, edge in enumerate(edges) if edge.a in inside))

    @staticmethod
    def around(centre: int, ends: NDArray[np.int64], always_fixed: int, most_free: int = MOST_FREE) -> "Neighbourhood":
        """Return the `most_free` nodes that are the fewest edges away from a centre, with their neighbours fixed.

        ends [E, 2]: of the edges of the graph. The node `always_fixed` is never free.
        """
        order = [centre]
        for node in order:
            if len(order) > most_free:  # always_fixed may be one of them
                break
            beside = ends[(ends == node).any(1)].ravel().tolist()
            order += [other for other in dict.fromkeys(beside) if other not in order]
        free = sorted([node for node in order if node != always_fixed][:most_free])
        rows = np.flatnonzero(np.isin(ends, free).any(1))
        fixed = np.setdiff1d(ends[rows], free).tolist()
        return Neighbourhood((*fixed, *free), len(fixed), tuple(rows.tolist()))

    def solve(
        self, T_world_node: Sequence[Matrix], edges: Sequence[RelativePose], rejected: Sequence[bool] = ()
    ) -> PoseGraphSolution:
        """Solve this part of a graph, given the pose [4, 4] of each node and the edges; the solution has one pose for
        each of `nodes`. rejected: for each of this part's edges, as in `optimise`."""
        part = numbered([edges[row] for row in self.edges], self.nodes)
        poses = np.stack([T_world_node[node] for node in self.nodes])
        return optimise(poses, part, fixed=self.fixed, rejected=rejected)


def numbered(edges: Sequence[RelativePose], nodes: Sequence[int]) -> list[RelativePose]:
    """Return edges with each node replaced by its place in `nodes`."""
    number = {node: i for i, node in enumerate(nodes)}
    return [replace(edge, a=number[edge.a], b=number[edge.b]) for edge in edges]


@dataclass(eq=False)
class PendingSearch:
    """The search for the loops of a finished submap that is not complete: the submap, the descriptors [D] of its
    keyframes, and the slices of `LoopCloser.closing` that are done."""

    submap: int
    descriptors: list[NDArray[np.float32]]
    slices: int = 0


@dataclass(eq=False)
class LoopCloser:
    """Keeps the descriptors of finished submaps and all edges between them. During a run only this class moves anchors.

    edges: trusted ones, such as odometry, and registered loops, each with its row in `loops` (`Edges.loop_row`).
    solved: the number of submaps when the whole pose graph was last solved. In between, and in a graph
    that is larger than the largest part, loops move only the submaps near them in the graph (`Neighbourhood`).
    pending: the searches that are not complete, the oldest first.
    """

    config: Config
    store: SubmapStore
    extractor: Extractor | None = None
    descriptors: DescribedSubmaps = field(default_factory=DescribedSubmaps)
    edges: Edges = field(default_factory=Edges)
    loops: Loops = field(default_factory=Loops)
    solved: int = 0
    pending: list[PendingSearch] = field(default_factory=list)

    def add_finished(self, submap: Submap, descriptors: Sequence[NDArray[np.float32]], T_first_submap: Matrix) -> None:
        """Add a submap of an earlier session: loops to it are tried, but it stays where it is relative to the first
        submap.

        descriptors [D]: one per keyframe, none if loops are not closed. T_first_submap [4, 4]: its pose in submap 0.
        """
        if descriptors:
            self.descriptors.append(self._described(submap, descriptors))
        if submap.index:
            self.edges.append(RelativePose(0, submap.index, T_first_submap, RIGID))

    @property
    def valid(self) -> Edges:
        """Return the trusted edges and the accepted loops."""
        rows = self.edges.loop_rows(range(len(self.edges)))
        valid = rows < 0
        valid[~valid] = self.loops.accepted[rows[~valid]]
        return self.edges.taken(valid)

    def _described(self, submap: Submap, descriptors: Sequence[NDArray[np.float32]]) -> SubmapDescriptor:
        c, log_variances = self.config.loops, submap.field.params[:, COLUMNS["log_variances"]].numpy()
        plain = self.config.registration.plain_gate
        ratio = opacity_ratio(submap.field.opacities.numpy(), log_variances, c.tau, c.weight_max, plain)
        return SubmapDescriptor(submap.index, np.stack(descriptors), ratio)

    def closing(
        self, submap: Submap, descriptors: Sequence[NDArray[np.float32]], atlas: Atlas, view: View
    ) -> Task[None]:
        """Look for loops from a finished submap to earlier ones, in slices of one alignment; if one is found, correct
        the anchors. `loops` then has the pairs that were tried.

        descriptors [D]: one per keyframe, in order, of unit norm or zero. Nothing changes before the last
        slice: a search that was begun can be made again from its first slice, as long as the anchors stay.
        """
        if not self.config.loops.close or not descriptors:
            return
        query = self._described(submap, descriptors)
        registrar = Registrar(self.config, self.store, view, self.extractor)
        tried = list[tuple[Loop, RelativePose | None]]()
        for pair in self._pairs(query, atlas):
            yield
            tried.append((yield from self._try(pair, submap, atlas, registrar)))
        self.descriptors.append(query)
        known = len(self.edges)
        for loop, edge in tried:
            self.loops.append(loop)
            if edge is not None:
                self.edges.append(edge, len(self.loops) - 1)
        if len(self.edges) > known:
            self._correct_at(atlas, submap.index, known)
        self.release()

    @property
    def columns(self) -> tuple[Column, ...]:
        """Return what grows most with the number of submaps."""
        return self.descriptors.rows, self.edges.rows, self.loops.rows

    def release(self) -> None:
        """Give RAM back to the system, after the whole history was read."""
        for column in self.columns:
            column.release()

    def _pairs(self, query: SubmapDescriptor, atlas: Atlas) -> list[SubmapPair]:
        """Choose the earlier submaps to register with: first similar ones, then those near by the current poses."""
        c = self.config.loops
        database, components = self.descriptors, np.array(atlas.components, np.int64)
        connected = components[database.numbers] == components[query.index]
        keyframes, plain = self.config.registration.keyframes, self.config.registration.plain_gate
        candidates = find_candidates(
            query, database, c.min_similarity, c.min_interval, c.similarity_floor, c.uncertainty, connected, plain
        )
        pairs = pairs_to_register(candidates, query, database, keyframes)
        if c.near_m:
            poses = atlas.T_world_keyframes_of([query.index, *database.numbers[connected].tolist()])
            near_rad, known = np.deg2rad(c.near_deg), {pair.best.database_submap for pair in pairs}
            near = find_nearby(query, database, poses, c.near_m, near_rad, c.min_interval, keyframes, connected)
            pairs += [pair for pair in near if pair.best.database_submap not in known]
        return pairs[: c.most or None]

    def _try(
        self, pair: SubmapPair, a: Submap, atlas: Atlas, registrar: Registrar
    ) -> Task[tuple[Loop, RelativePose | None]]:
        """Register a pair in slices, with `a` as the query; return the result, and its edge if it was accepted."""
        b = self.store.load(pair.best.database_submap)
        known = se3.inverse(atlas.anchors[a.index]) @ atlas.anchors[b.index]
        found = yield from registrar.register(pair, a, b, known)
        loop = described(pair.best, a, b, found, known)
        if not found.accepted:
            return loop, None
        edge = RelativePose(a.index, b.index, found.T_a_b, found.information, "loop", found.keyframes, found.drift)
        return loop, edge

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
            part = Neighbourhood.around(centre, self.edges.ends, members[0], most_free)
        small = len(members) <= MOST_FREE
        loop_rows = self.edges.loop_rows(part.edges).tolist()
        rejected = [] if small else [row >= 0 and self.loops.is_rejected(row) for row in loop_rows]
        solution = part.solve(atlas.anchors, self.edges, rejected)
        for submap, T_world_submap in zip(part.nodes, solution.T_world_node, strict=True):
            atlas.anchors[submap] = T_world_submap
        tested = [row for row in loop_rows if row >= 0]
        for row, verdict in zip(tested, solution.verdicts, strict=True):
            self.loops.judge(row, verdict)
        if whole:
            self.solved = max(self.solved, len(members))
        return whole
