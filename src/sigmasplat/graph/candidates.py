"""Loop candidates: submaps that may show the same place, and the keyframes to register them by (VarSplat §4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from sigmasplat.data.poses import Column, Records
from sigmasplat.tracking.descriptors import similarity
from sigmasplat.types import Matrix

Descriptors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SubmapDescriptor:
    """Descriptors of a finished submap.

    index: its number; descriptors [n, D]: one per keyframe, unit norm; opacity_ratio: r of its splats.
    """

    index: int
    descriptors: Descriptors
    opacity_ratio: float = 1.0


@dataclass(eq=False)
class DescribedSubmaps(Records[SubmapDescriptor]):
    """Descriptors of S submaps, in the order in which their loops were searched.

    rows [K, D]: of all keyframes, submap by submap; facts [S, 3]: number of the submap, opacity_ratio, end of its rows.
    """

    rows: Column = field(default_factory=lambda: Column.of(np.float32, 0))
    facts: Column = field(default_factory=lambda: Column.of(np.float64, 3))

    def append(self, submap: SubmapDescriptor) -> None:
        """Append a submap. All have descriptors of the same length."""
        if not len(self.rows) and len(submap.descriptors):  # now their length is known
            folder, self.rows = self.rows.folder, Column.of(np.float32, submap.descriptors.shape[1])
            self.rows.folder = folder
        if len(submap.descriptors):
            self.rows.extend(submap.descriptors)
        self.facts.append([submap.index, submap.opacity_ratio, len(self.rows)])

    def __len__(self) -> int:
        return len(self.facts)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Return the number of each submap [S]."""
        return self.facts.used[:, 0].astype(np.int64)

    @property
    def opacity_ratio(self) -> Matrix:
        """Return r of the splats of each submap [S]."""
        return self.facts.used[:, 1].copy()

    @property
    def counts(self) -> NDArray[np.int64]:
        """Return the number of keyframes of each submap [S]."""
        ends = np.concatenate([[0], self.facts.used[:, 2]]).astype(np.int64)
        return np.asarray(ends[1:] - ends[:-1])

    def _record(self, i: int) -> SubmapDescriptor:
        index, ratio, end = self.facts.used[i].tolist()
        first = int(self.facts.used[i - 1, 2]) if i else 0
        return SubmapDescriptor(int(index), self.rows.used[first : int(end)], ratio)


GATE_LEAST, GATE_MOST = 0.85, 1.20
"""Limits of the factor by which the variance of two submaps changes the similarity of their keyframes."""


@dataclass(frozen=True)
class Candidate:
    """Two similar keyframes of different submaps; gated = similarity × gate.

    Keyframe numbers count within the submap, as the rows of its descriptors do.
    """

    query_submap: int
    query_keyframe: int
    database_submap: int
    database_keyframe: int
    similarity: float
    gated: float


@dataclass(frozen=True)
class SubmapPair:
    """Two submaps to register; best: their most similar keyframes; keyframes: those to localise in the other submap."""

    best: Candidate
    query_keyframes: tuple[int, ...]
    database_keyframes: tuple[int, ...]


def variance_weights(
    log_variances: NDArray[np.floating], tau: float = 10.0, weight_max: float = 3.0, plain: bool = False
) -> Matrix:
    """Return a weight per splat [N], high for a low colour variance (VarSplat §4, w_i).

    w = clamp(exp(−(log σ̄² − median)/τ) / mean, 1/weight_max, weight_max), without clamp and mean if `plain`. σ̄² is the
    mean over the channels of σ² = exp(log_variances [N, 3]); "mean" is that of exp(·) over the submap's splats. A
    common factor in all σ² cancels.
    """
    log_mean = logsumexp(np.asarray(log_variances, np.float64), axis=1)
    if plain:
        return np.exp((np.median(log_mean) - log_mean) / tau) if len(log_mean) else log_mean
    # exp(·) / mean is N × softmax, in which the median and the ⅓ of the channel mean cancel and nothing overflows.
    return np.clip(len(log_mean) * softmax(-log_mean / tau), 1.0 / weight_max, weight_max)


def opacity_ratio(
    opacities: NDArray[np.floating], log_variances: NDArray[np.floating], tau: float = 10.0, weight_max: float = 3.0,
    plain: bool = False,
) -> float:  # fmt: skip
    """Return r = Σ w o / Σ o of a submap's splats (VarSplat §4): above 1 if opaque splats have low variance.

    opacities [N] in [0, 1], log_variances [N, 3]; plain: as in `variance_weights`. r is 1 if all σ² are equal, or if no
    splat is opaque.
    """
    opaque = np.asarray(opacities, np.float64)
    total = float(opaque.sum())
    return float(variance_weights(log_variances, tau, weight_max, plain) @ opaque) / total if total > 0.0 else 1.0


def gate(query_ratio: float, database_ratio: float | Matrix, plain: bool = False) -> Matrix:
    """Return r(q) · r(d) of each database ratio [n], clamped to 0.85 … 1.20 unless it is `plain` (VarSplat §4)."""
    product = np.asarray(query_ratio * database_ratio)
    return product if plain else product.clip(GATE_LEAST, GATE_MOST)


def self_similarity(descriptors: Descriptors, min_similarity: float = 0.5) -> Matrix:
    """Return, for each keyframe of a submap [n], the similarity that another view must exceed (VarSplat §4).

    It is the k-th highest similarity to the n keyframes of the same submap, itself included, with k =
    max(⌊n · min_similarity⌋, 1); with 0.5 it is the median. A single keyframe has threshold 1.
    """
    count = len(descriptors)
    if count == 0:
        return np.zeros(0)
    k = max(int(count * min_similarity), 1)
    return np.sort(similarity(descriptors, descriptors), axis=1)[:, count - k]


def find_candidates(
    query: SubmapDescriptor, known: DescribedSubmaps, min_similarity: float = 0.5, min_interval: int = 2,
    similarity_floor: float = 0.0, uncertainty: bool = True, among: NDArray[np.bool_] | None = None,
    plain: bool = False,
) -> list[Candidate]:  # fmt: skip
    """List the keyframe pairs of the query and other submaps that may show the same place (VarSplat §4), best first.

    A pair counts if its submaps are at least `min_interval` apart, if similarity × gate exceeds the query keyframe's
    `self_similarity`, and if the similarity without gate exceeds `similarity_floor` (a submap of dissimilar views has a
    low `self_similarity`). Without `uncertainty` the gate is 1. The order is by gated similarity, then by database
    submap, query keyframe, database keyframe; the order of `known` does not matter.

    among [S]: which of the known submaps are compared; None: all. plain: as in `gate`.
    """
    threshold = self_similarity(query.descriptors, min_similarity)
    wanted = _apart(query, known, min_interval) & (True if among is None else among)
    gates = gate(query.opacity_ratio, known.opacity_ratio, plain) if uncertainty else np.ones(len(known))
    found: list[Candidate] = []
    for row in np.flatnonzero(wanted).tolist() if len(threshold) else ():
        other, factor = known[row], gates[row]
        alike = similarity(query.descriptors, other.descriptors)
        rows, columns = np.nonzero((alike * factor > threshold[:, None]) & (alike > similarity_floor))
        found += [
            Candidate(query.index, int(q), other.index, int(d), float(alike[q, d]), float(alike[q, d] * factor))
            for q, d in zip(rows, columns, strict=True)
        ]
    return sorted(found, key=lambda c: (-c.gated, c.database_submap, c.query_keyframe, c.database_keyframe))


def find_nearby(
    query: SubmapDescriptor, known: DescribedSubmaps, T_world_keyframe: Mapping[int, Matrix], near_m: float,
    near_rad: float, min_interval: int = 2, keyframes: int = 2, among: NDArray[np.bool_] | None = None,
) -> list[SubmapPair]:  # fmt: skip
    """List pairs of submaps that show the same place according to the current poses, nearest first.

    An addition to the paper: while drift is small, poses find more revisits than descriptors do. T_world_keyframe:
    poses [K, 4, 4] of each of these submaps, by its index; among: as in `find_candidates`. A pair counts if two
    keyframes are nearer than near_m and their rotations differ by less than near_rad. The nearest `keyframes` of each
    side, in units of both limits, are to be localised.
    """
    wanted = _apart(query, known, min_interval) & (True if among is None else among)
    if not wanted.any():
        return []
    ours, others = T_world_keyframe[query.index], known.numbers[wanted]
    poses = [T_world_keyframe[index] for index in others.tolist()]
    first = np.cumsum([0, *map(len, poses)])
    apart_m, apart_rad = _differences(ours, np.concatenate(poses))
    far = apart_m / near_m + apart_rad / near_rad
    within = np.where((apart_m < near_m) & (apart_rad < near_rad), far, np.inf)
    nearest = np.minimum.reduceat(within.min(0), first[:-1])
    found, rows = [], np.flatnonzero(wanted)
    for row in sorted(np.flatnonzero(np.isfinite(nearest)), key=lambda row: (nearest[row], others[row])):
        other, ours_theirs = known[int(rows[row])], far[:, first[row] : first[row + 1]]
        q, d = np.argwhere(within[:, first[row] : first[row + 1]] == nearest[row])[0].tolist()
        alike = float(similarity(query.descriptors[q : q + 1], other.descriptors[d : d + 1])[0, 0])
        best = Candidate(query.index, q, other.index, d, alike, alike)
        sides = _highest(-ours_theirs.min(1), keyframes), _highest(-ours_theirs.min(0), keyframes)
        found.append(SubmapPair(best, *sides))
    return found


def _apart(query: SubmapDescriptor, known: DescribedSubmaps, min_interval: int) -> NDArray[np.bool_]:
    """Return which submaps [S] have keyframes and are at least `min_interval` apart from the query, without the query
    itself."""
    return np.asarray((np.abs(known.numbers - query.index) >= max(min_interval, 1)) & (known.counts > 0))


def _differences(a: Matrix, b: Matrix) -> tuple[Matrix, Matrix]:
    """Return the distances [n, m] (m) and the angles [n, m] (rad) between poses a [n, 4, 4] and b [m, 4, 4]."""
    apart_m = np.linalg.norm(a[:, None, :3, 3] - b[None, :, :3, 3], axis=-1)
    cosine = (np.einsum("aij,bij->ab", a[:, :3, :3], b[:, :3, :3]) - 1.0) / 2.0
    return apart_m, np.arccos(np.clip(cosine, -1.0, 1.0))


def pairs_to_register(
    candidates: Sequence[Candidate], query: SubmapDescriptor, known: DescribedSubmaps, keyframes: int = 2
) -> list[SubmapPair]:
    """Group a query's candidates by submap, the best pairs first, and choose the keyframes to localise (VarSplat §5).

    candidates: the result of `find_candidates` for the same submaps. Of each side, the `keyframes` most
    similar to any keyframe of the other side are chosen, most similar first.
    """
    best: dict[int, Candidate] = {}
    for candidate in candidates:
        best.setdefault(candidate.database_submap, candidate)
    pairs = []
    for index, candidate in best.items():
        alike = similarity(query.descriptors, known[int(np.flatnonzero(known.numbers == index)[0])].descriptors)
        pairs.append(SubmapPair(candidate, _highest(alike.max(1), keyframes), _highest(alike.max(0), keyframes)))
    return pairs


def _highest(scores: Matrix, count: int) -> tuple[int, ...]:
    """Return the indices of the highest scores, best first; between equal scores the lower index first."""
    return tuple(int(i) for i in np.argsort(-scores, kind="stable")[:count])
