"""The graph of keyframes while it grows: each new keyframe is aligned to earlier ones, and the newest are solved.

This is a window of the graph that the end of a run solves as a whole (`keyframe_graph`). CG-SLAM adjusts a window of
keyframes together with the map; here the relative poses stand for the map.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.relative_pose import Alignments, RelativePose
from sigmasplat.data.submap import Picture
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import picture_images
from sigmasplat.graph.keyframe_graph import edge_between, hop_between, partners, solve
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, ShouldStop, Task, never

WINDOW = 10
"""So many of the newest keyframes move. Older ones move when a loop is closed, and at the end of the run."""
CACHE_BYTES = 1 << 28
"""Images of keyframes that stay in memory."""


@dataclass(eq=False)
class GrowingGraph:
    """Keeps the alignments of all keyframes; their nodes are rows of `Atlas.T_world_keyframes`. most: per keyframe."""

    most: int
    edges: Alignments = field(default_factory=Alignments)

    def aligning(
        self,
        T_world_keyframe: Matrix,
        rows: NDArray[np.int64],
        image: Callable[[int], Pyramid],
        should_stop: ShouldStop = never,
    ) -> Task[None]:
        """Align the newest keyframe of T_world_keyframe [K, 4, 4] to earlier ones, one per slice, until `should_stop`.

        rows [n]: which keyframes may be used, in order; the newest is the last one.
        """
        b = int(rows[-1])
        live = image(b)
        for i in partners(T_world_keyframe[rows], float(live.readings[0]), live.cameras[0].width_rad, self.most):
            a = int(rows[i])
            guess = se3.inverse(T_world_keyframe[b]) @ T_world_keyframe[a]
            edge = edge_between(a, b, image(a), live, guess)
            if edge is not None:
                self.edges.append(edge)
            if should_stop():
                return
            yield

    def solved(self, T_world_keyframe: Matrix, hops: Sequence[RelativePose], first: int) -> Matrix:
        """Return the poses [n, 4, 4] of the keyframes from row `first` on that agree best with their edges to each
        other and to earlier keyframes, which stay; those of T_world_keyframe [K, 4, 4] are the first guess. hops: one
        to each of them."""
        T = T_world_keyframe
        rows_of_hops = zip(range(first, len(T)), hops, strict=True)
        edges = [hop_between(row, row - 1, hop, se3.inverse(T[row]) @ T[row - 1]) for row, hop in rows_of_hops]
        edges += self.edges.touching(first)
        rows = np.unique([*(edge.a for edge in edges), *(edge.b for edge in edges)])
        node = {row: i for i, row in enumerate(rows.tolist())}
        local = [RelativePose(node[e.a], node[e.b], e.T_a_b, e.information, e.kind) for e in edges]
        fixed = int((rows < first).sum())
        return solve(T[rows], local, fixed).T_world_keyframe[fixed:]


@dataclass(eq=False)
class KeyframeImages:
    """Images of keyframes for alignment. They are made from what the map keeps of them, so that a resumed run aligns
    the same; those that were used last stay in memory.

    kept: by row of `Atlas.T_world_keyframes`: number of readings, and images.
    """

    kept: dict[int, tuple[int, Pyramid]] = field(default_factory=dict)

    def of(self, row: int, view: View, picture: Callable[[], Picture], readings: int | None = None) -> Pyramid:
        """Return the images of a keyframe; readings: of its depth, if the map may still mask some; None: no more."""
        found = self.kept.pop(row, None)
        if found is None or readings not in (None, found[0]):
            target, pyramid = picture_images(view, picture(), view.camera)
            found = target.valid_pixels, pyramid
        self.kept[row] = found
        if len(self.kept) > max(2, CACHE_BYTES // (16 * view.camera.width * view.camera.height)):
            del self.kept[next(iter(self.kept))]
        return found[1]

    def settle(self, row: int, readings: int) -> None:
        """Forget the images of a keyframe whose depth was masked since, which is final from now on."""
        if row in self.kept and self.kept[row][0] != readings:
            del self.kept[row]
