"""Decide which submaps may show the same place, and by which keyframes to register them (VarSplat §4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, softmax

from sigmasplat.slam.loop_closure.descriptors import similarity
from sigmasplat.types import Matrix

Descriptors = NDArray[np.float32]

GATE_LEAST, GATE_MOST = 0.85, 1.20
"""How far the variance of two submaps may lower or raise the similarity of their keyframes."""


@dataclass(frozen=True, eq=False)
class SubmapDescriptor:
    """What is remembered of a finished submap for recognising it.

    index: position among the submaps; descriptors [n, D], one per keyframe, unit norm; opacity_ratio: r of its splats.
    """

    index: int
    descriptors: Descriptors
    opacity_ratio: float = 1.0


@dataclass(frozen=True)
class Candidate:
    """A keyframe of one submap that looks like a keyframe of another; gated = similarity × gate.

    Keyframes count within their submap, as the rows of its descriptors do.
    """

    query_submap: int
    query_keyframe: int
    database_submap: int
    database_keyframe: int
    similarity: float
    gated: float


@dataclass(frozen=True)
class SubmapPair:
    """Two submaps worth registering; best: their most similar keyframes; keyframes: who is localised in the other."""

    best: Candidate
    query_keyframes: tuple[int, ...]
    database_keyframes: tuple[int, ...]


def variance_weights(log_variances: NDArray[np.floating], tau: float = 10.0, weight_max: float = 3.0) -> Matrix:
    """Weigh splats by how steady their colour is (VarSplat §4, w_i), [N].

    w = clamp(exp(−(log σ̄² − median)/τ) / mean, 1/weight_max, weight_max), σ̄² the mean over the channels of σ² =
    exp(log_variances [N, 3]), the mean of exp(·) over the submap's splats. A common factor in all σ² cancels.
    """
    log_mean = logsumexp(np.asarray(log_variances, np.float64), axis=1)
    # exp(·) / mean is N × softmax, in which the median and the ⅓ of the channel mean cancel and nothing overflows.
    return np.clip(len(log_mean) * softmax(-log_mean / tau), 1.0 / weight_max, weight_max)


def opacity_ratio(
    opacities: NDArray[np.floating], log_variances: NDArray[np.floating], tau: float = 10.0, weight_max: float = 3.0
) -> float:
    """Return r = Σ w o / Σ o of a submap's splats (VarSplat §4): above 1 where the opaque ones are the steady ones.

    opacities [N] in [0, 1], log_variances [N, 3]. 1 where all σ² are equal, and where there is nothing opaque to judge.
    """
    opaque = np.asarray(opacities, np.float64)
    total = float(opaque.sum())
    return float(variance_weights(log_variances, tau, weight_max) @ opaque) / total if total > 0.0 else 1.0


def gate(query_ratio: float, database_ratio: float) -> float:
    """Return clamp(r(q) · r(d), 0.85, 1.20) (VarSplat §4)."""
    return float(np.clip(query_ratio * database_ratio, GATE_LEAST, GATE_MOST))


def self_similarity(descriptors: Descriptors, min_similarity: float = 0.5) -> Matrix:
    """Return for each keyframe of a submap [n] how alike another view must be to count as the same place (VarSplat §4).

    It is the keyframe's k-th highest similarity to the n keyframes of its own submap, itself included, with k =
    max(⌊n · min_similarity⌋, 1): at 0.5 the median of a place seen from nearby. A lone keyframe has threshold 1.
    """
    count = len(descriptors)
    if count == 0:
        return np.zeros(0)
    k = max(int(count * min_similarity), 1)
    return np.sort(similarity(descriptors, descriptors), axis=1)[:, count - k]


def find_candidates(
    query: SubmapDescriptor,
    database: Sequence[SubmapDescriptor],
    min_similarity: float = 0.5,
    min_interval: int = 2,
    similarity_floor: float = 0.0,
    uncertainty: bool = True,
) -> list[Candidate]:
    """List the keyframe pairs of the query with other submaps that may show one place (VarSplat §4), best first.

    A pair counts when its submaps are at least `min_interval` apart, when similarity × gate exceeds the query
    keyframe's `self_similarity`, and when the similarity itself, ungated, exceeds `similarity_floor`: a submap of
    unlike views has a low threshold, and no gate makes strangers of one place. `uncertainty` off = gate 1. The order is
    by gated similarity; ties by database submap, query keyframe, database keyframe; not by how `database` is ordered.
    """
    threshold = self_similarity(query.descriptors, min_similarity)
    found: list[Candidate] = []
    for other in database:
        if abs(other.index - query.index) < max(min_interval, 1):
            continue
        factor = gate(query.opacity_ratio, other.opacity_ratio) if uncertainty else 1.0
        alike = similarity(query.descriptors, other.descriptors)
        rows, columns = np.nonzero((alike * factor > threshold[:, None]) & (alike > similarity_floor))
        found += [
            Candidate(query.index, int(q), other.index, int(d), float(alike[q, d]), float(alike[q, d] * factor))
            for q, d in zip(rows, columns, strict=True)
        ]
    return sorted(found, key=lambda c: (-c.gated, c.database_submap, c.query_keyframe, c.database_keyframe))


def find_nearby(
    query: SubmapDescriptor,
    database: Sequence[SubmapDescriptor],
    T_world_keyframe: Sequence[Matrix],
    near_m: float,
    near_rad: float,
    min_interval: int = 2,
    keyframes: int = 2,
) -> list[SubmapPair]:
    """List pairs of submaps that by the poses known so far see one place, whatever they look like; nearest first.

    Ours, beside the paper's: where drift is small, poses know of more revisits than descriptors do. T_world_keyframe:
    per submap by its index, [K, 4, 4]. Pairs count with keyframes nearer than near_m and turned by less than near_rad;
    the nearest `keyframes` of each side, in units of both limits, are to be localised.
    """
    found: list[tuple[float, SubmapPair]] = []
    ours = T_world_keyframe[query.index]
    for other in database:
        if abs(other.index - query.index) < max(min_interval, 1):
            continue
        theirs = T_world_keyframe[other.index]
        apart_m = np.linalg.norm(ours[:, None, :3, 3] - theirs[None, :, :3, 3], axis=-1)
        cosine = (np.einsum("aij,bij->ab", ours[:, :3, :3], theirs[:, :3, :3]) - 1.0) / 2.0
        apart_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        far = apart_m / near_m + apart_rad / near_rad
        within = np.where((apart_m < near_m) & (apart_rad < near_rad), far, np.inf)
        q, d = (int(i) for i in np.unravel_index(int(within.argmin()), far.shape))
        if np.isfinite(within[q, d]):
            alike = float(similarity(query.descriptors[q : q + 1], other.descriptors[d : d + 1])[0, 0])
            best = Candidate(query.index, q, other.index, d, alike, alike)
            sides = _highest(-far.min(1), keyframes), _highest(-far.min(0), keyframes)
            found.append((float(within[q, d]), SubmapPair(best, *sides)))
    return [pair for _, pair in sorted(found, key=lambda f: (f[0], f[1].best.database_submap))]


def pairs_to_register(
    candidates: Sequence[Candidate], query: SubmapDescriptor, database: Sequence[SubmapDescriptor], keyframes: int = 2
) -> list[SubmapPair]:
    """Gather a query's candidates by submap, best pair first, with the keyframes to localise (VarSplat §5).

    candidates are `find_candidates`' for the same query and database. Of each side those `keyframes` are taken whose
    best similarity to the other side's keyframes is highest, in that order; fewer where there are fewer.
    """
    signatures = {signature.index: signature for signature in database}
    best: dict[int, Candidate] = {}
    for candidate in candidates:
        best.setdefault(candidate.database_submap, candidate)
    pairs = []
    for index, candidate in best.items():
        alike = similarity(query.descriptors, signatures[index].descriptors)
        pairs.append(SubmapPair(candidate, _highest(alike.max(1), keyframes), _highest(alike.max(0), keyframes)))
    return pairs


def _highest(scores: Matrix, count: int) -> tuple[int, ...]:
    """Return where the highest scores stand, best first; of equal ones the earlier."""
    return tuple(int(i) for i in np.argsort(-scores, kind="stable")[:count])
