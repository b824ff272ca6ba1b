"""The final map: merge all submaps, or seed new splats on their surface, and refine over all keyframes (VarSplat §7).

What moves is kept out, as `mapping.moving` keeps it out of each submap: keyframes are compared across submaps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field as dataclass_field, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config, FinalConfig
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.submap import KeyframeId, Picture, SubmapStore
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.errors import SigmaSplatError
from sigmasplat.final.full_resolution import refine_on_photos, working_seconds
from sigmasplat.final.fusion import count_keyframes, fuse, fusion_views
from sigmasplat.final.refinement import Clock, KeyframeReader, refine
from sigmasplat.final.stores import RefinedStore
from sigmasplat.final.tsdf import packed
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.mapping.moving import contradicted, is_free, remove
from sigmasplat.render.view import View
from sigmasplat.types import Matrix, Progress, no_progress

CELL_M, BITS = 0.01, 16
"""Size of the cells of `z_order`, and the bits of a cell's number along each axis."""
AT_ONCE = 1 << 22
"""Duplicates are removed when so many splats wait, so that memory does not grow with the time in one room."""


class FinalMap(NamedTuple):
    """The global map in the world, in host memory; the poses of its keyframes, T_submap_camera [4, 4] of each submap's
    keyframes, as refinement has moved them (None: it has moved none); their exposures [K, 3, 2] relative to the map
    (None: not fitted); the number of refinement steps."""

    field: GaussianField
    keyframe_poses: list[list[Matrix]] | None = None
    keyframe_exposures: list[Matrix] | None = None
    steps: int = 0
    refined_fx: float | None = None


def final_map(
    store: SubmapStore, anchors: Sequence[Matrix], config: Config, view: View, random: np.random.Generator,
    progress: Progress = no_progress,
) -> FinalMap:  # fmt: skip
    """Return the map in the world: made from submaps at `anchors` (T_world_submap [4, 4] each), then refined with
    `view`.

    Calls `progress(steps done, total)`. Memory contains this map, one submap and some pictures. All submaps have the
    view's camera.
    """
    seed = seeded_on_surface if config.final.seed_from == "mesh" else merged
    if config.moving.find:
        store = without_moving(store, anchors, config)
    field, keyframes = seed(store, anchors, config), KeyframeReader(store, anchors, view)
    if config.moving.find:  # remove splats from space that the keyframes of all submaps see to be free
        remove(field, is_free(field.means.numpy(), keyframes, config.moving.carve_votes, config.render.scene_scale))
    if not config.final.iterations:
        return FinalMap(field)
    field.keep(torch.from_numpy(z_order(field.means.numpy())))
    on_device = field.to(view.sums.device)
    clock = Clock(working_seconds(keyframes, config.final))
    done = len(refine(on_device, keyframes, config, view, random, progress, clock))
    clock = clock.next_stage(config.final.seconds)
    done, refined_fx = refine_on_photos(on_device, keyframes, config, view, random, progress, done, clock)
    moves = config.final.lr_pose_translation or config.final.lr_pose_rotation
    poses = keyframes.poses_in(anchors) if moves else None
    exposures = keyframes.exposures_in_submaps() if config.final.exposure else None
    return FinalMap(on_device.to(torch.device("cpu")), poses, exposures, done, refined_fx)


# ---- merging ----


class OwnedSplats(NamedTuple):
    """Splats in the world, the submap of each [N], and its log σ² [N]."""

    field: GaussianField
    owner: NDArray[np.int64]
    log_variance: Tensor


def merged(store: SubmapStore, anchors: Sequence[Matrix], config: Config) -> GaussianField:
    """Merge the splats of all submaps in the world (anchors: T_world_submap [4, 4]), without duplicates (`survivors`).

    If there are more than `AT_ONCE` splats, duplicates are removed before all submaps are read. The result is the same:
    the splats that win a voxel stay complete, and so does their mean.
    """
    kept, waiting = list[OwnedSplats](), list[OwnedSplats]()
    for index in range(len(store)):
        part = store.load(index).field.moved(torch.from_numpy(anchors[index]))
        log_variance = part.params[:, COLUMNS["log_variances"]].mean(1)
        waiting.append(OwnedSplats(part, np.full(len(part), index), log_variance))
        if _count(waiting) >= max(AT_ONCE, _count(kept)):
            kept, waiting = [_without_duplicates([*kept, *waiting], config)], []
    return _without_duplicates([*kept, *waiting], config).field


def _count(parts: Sequence[OwnedSplats]) -> int:
    return sum(len(part.field) for part in parts)


def _without_duplicates(parts: Sequence[OwnedSplats], config: Config) -> OwnedSplats:
    """Return the splats of parts that survive, in their order."""
    field = GaussianField.side_by_side(part.field for part in parts)
    owner, log_variance = np.concatenate([part.owner for part in parts]), torch.cat([p.log_variance for p in parts])
    weigh = np.asarray(log_variance.double()) if config.final.uncertainty else None
    keep = survivors(field.means.numpy(), owner, weigh, config.final.merge_m * config.render.scene_scale)
    field.keep(torch.from_numpy(keep))
    return OwnedSplats(field, owner[keep], log_variance[torch.from_numpy(keep)])


def survivors(
    means: NDArray[np.floating], owner: NDArray[np.int64], log_variance: NDArray[np.float64] | None, spacing_m: float
) -> NDArray[np.bool_]:
    """Return which splats to keep, bool [N]: in each voxel of `spacing_m` only the splats of one submap.

    means [N, 3] m, world; owner [N]: the submap of each splat; log_variance [N]: log σ². The submap with the lowest
    mean log σ² in the voxel is kept; without log_variance, or between equal means, the earlier submap.
    """
    submaps = int(owner.max(initial=0)) + 1
    _, voxel = np.unique(packed(np.floor(means / spacing_m).astype(np.int64)), return_inverse=True)
    pairs, pair = np.unique(voxel * submaps + owner, return_inverse=True)
    place, score = pairs // submaps, np.zeros(len(pairs))
    if log_variance is not None:
        score += np.bincount(pair, log_variance) / np.bincount(pair)
    order = np.lexsort((pairs % submaps, score, place))
    _, first = np.unique(place[order], return_index=True)
    return np.isin(pair, order[first])


def z_order(points: Matrix) -> NDArray[np.int64]:
    """Return the rows of points [N, 3] m in the order of the Z-curve (Morton) through cells of `CELL_M`.

    Kernels process splats in groups of neighbouring rows. In this order a camera sees most groups completely or not at
    all, so it does less work.
    """
    cells = np.floor((points - points.min(0, initial=np.inf)) / CELL_M).clip(0, (1 << BITS) - 1).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


# ---- seeding on the surface ----


def seeded_on_surface(store: SubmapStore, anchors: Sequence[Matrix], config: Config) -> GaussianField:
    """Place splats on the fused surface of the submaps, with distance and size `spacing_m` (VarSplat §7).

    anchors: T_world_submap [4, 4] of each submap. Raises SigmaSplatError if there is no surface.
    """
    mesh = fuse(fusion_views(store, anchors), count_keyframes(store), config)
    if not len(mesh.vertices):
        raise SigmaSplatError("the submaps have no surface for the seeds of the final map; use final.seed_from=submaps")
    spacing_m = config.final.spacing_m * config.render.scene_scale
    points, colors = thinned_vertices(mesh, spacing_m)
    scales = torch.full((len(points), 3), spacing_m)
    return GaussianField.from_values(torch.from_numpy(points).float(), scales, torch.from_numpy(colors).float())


def thinned_vertices(mesh: Mesh, spacing_m: float) -> tuple[Matrix, Matrix]:
    """Return the mean position [M, 3] m and colour [M, 3] of a mesh's vertices in each voxel of `spacing_m`."""
    cells = packed(np.floor(mesh.vertices / spacing_m).astype(np.int64))
    _, cell, counts = np.unique(cells, return_inverse=True, return_counts=True)
    colors = np.full_like(mesh.vertices, 0.5) if mesh.colors is None else mesh.colors
    sums = [np.bincount(cell, column) for column in (*mesh.vertices.T, *colors.T)]
    means = np.stack(sums, 1) / counts[:, None]
    return means[:, :3], means[:, 3:]


SHARE = 0.5
"""The reach as a share of the stated standard deviation of keyframe positions. It is about 1 mm with exact depth: with
1 cm, refinement would double the error of such a path."""
KEYFRAMES_MOST = 40
"""The standard deviation is the median of at most this many keyframes, evenly spread: each one costs milliseconds."""


@dataclass(frozen=True)
class ReachingFinalConfig(FinalConfig):
    """The settings of a refinement with a reach of its own (`reaching`)."""

    lr_pose_translation: float = 0.0
    lr_pose_rotation: float = 0.0
    pose_reach_m: float = 0.0


def reaching(config: Config, path: PathCovariance) -> FinalConfig:
    """Return the settings of a refinement with a reach that follows from the errors of the path (ours).

    The reach is `SHARE` times the median standard deviation of keyframe positions, from `pose_reach_m` to
    `pose_reach_most_m`. The learning rates of poses grow in the same proportion. If tracking has estimated the errors
    of less than half of the hops, as tracking by descent does, the reach stays `pose_reach_m`.
    """
    final, scale, factor = config.final, config.render.scene_scale, 1.0
    if not final.pose_reach_m:
        return final
    reach_m, most_m = final.pose_reach_m * scale, final.pose_reach_most_m * scale
    if most_m > reach_m and is_estimated(path):
        least_m, reach_m = reach_m, min(max(SHARE * position_std_m(path), reach_m), most_m)
        factor = reach_m / least_m
    return ReachingFinalConfig(
        **vars(final),
        pose_reach_m=reach_m,
        lr_pose_translation=factor * (final.lr_pose_translation * scale),
        lr_pose_rotation=factor * final.lr_pose_rotation,
    )


def is_estimated(path: PathCovariance) -> bool:
    """Return whether tracking has estimated the errors of at least half of the hops between keyframes."""
    submap = path.keyframe_submap
    is_hop = np.concatenate([[False], submap[1:] == submap[:-1]])  # the first keyframe of a submap has none
    known = np.asarray(np.isfinite(path.hops.covariance).all((1, 2)))
    return bool(is_hop.any()) and float(known[is_hop].mean()) >= 0.5


def position_std_m(path: PathCovariance) -> float:
    """Return the median standard deviation of keyframe positions relative to the first camera, m: the square root of
    the sum over the axes."""
    submaps = path.keyframe_submap
    numbers = np.arange(len(submaps)) - np.searchsorted(submaps, submaps)  # of each keyframe in its submap
    rows = evenly_spread(range(len(submaps)), KEYFRAMES_MOST)
    covariances = (path.of_keyframe(int(submaps[row]), int(numbers[row])) for row in rows)
    return float(np.median([np.sqrt(np.trace(covariance[:3, :3])) for covariance in covariances]))


STEPS_BACK = (1, 3, 6, 10)
"""A keyframe is compared with those so many before it, and with the `REVISITS` nearest of all earlier ones."""
REVISITS = 2
TURN_M = 1.0
"""Keyframes are near each other by the distance of their cameras, and by so many metres per radian of turn."""


@dataclass(frozen=True, eq=False)
class StillStore(RefinedStore):
    """A store whose keyframes have no depth where something moved.

    hidden: the pixels [H, W] of each keyframe that are masked, packed into bits, by submap and keyframe.
    """

    hidden: dict[KeyframeId, NDArray[np.uint8]] = dataclass_field(default_factory=dict)

    def picture(self, index: int, keyframe: int) -> Picture:
        picture, bits = self.store.picture(index, keyframe), self.hidden.get((index, keyframe))
        if bits is None:
            return picture
        hidden = np.unpackbits(bits, count=picture.depth_m.size).reshape(picture.depth_m.shape).astype(bool)
        return replace(picture, depth_m=np.where(hidden, np.float32(0.0), picture.depth_m))

    def hide(self, place: KeyframeId, pixels: NDArray[np.bool_]) -> None:
        """Mask more pixels [H, W] of a keyframe."""
        bits = np.packbits(pixels)
        self.hidden[place] = bits | self.hidden.get(place, bits)


def without_moving(store: SubmapStore, anchors: Sequence[Matrix], config: Config) -> StillStore:
    """Return the store with what moves masked in its keyframes; anchors: T_world_submap [4, 4] of each submap."""
    still, most = StillStore(store), config.moving.still_frames
    places, poses, frames = list[KeyframeId](), list[Matrix](), list[int]()
    for s, anchor in enumerate(anchors):
        submap = store.load(s)
        places += [(s, k) for k in range(len(submap.frames))]
        poses += [anchor @ T for T in submap.T_submap_camera]
        frames += submap.frames
    for late, others in enumerate(_compared(poses)):
        for early in others:
            close = frames[late] - frames[early] <= most or not most
            for own, other in ((early, late), (late, early))[: 1 + close]:
                own_m, other_m = (still.picture(*places[n]).depth_m for n in (own, other))
                T_other_own = se3.inverse(poses[other]) @ poses[own]
                pixels = contradicted(own_m, other_m, T_other_own, submap.camera, config.render.scene_scale)
                if pixels is not None:
                    still.hide(places[own], pixels)
    return still


def _compared(poses: Sequence[Matrix]) -> Iterator[list[int]]:
    """Yield the earlier keyframes that each one is compared with."""
    positions = np.array([T[:3, 3] for T in poses])
    ahead = np.array([T[:3, 2] for T in poses])
    for late in range(len(poses)):
        others = [late - n for n in STEPS_BACK if n <= late]
        rest = max(late - STEPS_BACK[-1], 0)
        if rest:
            turn = np.arccos(np.clip(ahead[:rest] @ ahead[late], -1.0, 1.0))
            apart = np.linalg.norm(positions[:rest] - positions[late], axis=1) + TURN_M * turn
            others += np.argsort(apart, kind="stable")[:REVISITS].tolist()
        yield others
