"""Make one map of all submaps once the frames have ended: merge them, or seed anew on their surface; refine it over
every keyframe (VarSplat §7)."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sigmasplat.config import Config, FinalConfig, MappingConfig
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.model.field import COLUMNS, INITIAL_LOG_VARIANCE, GaussianField, Rows
from sigmasplat.model.harmonics import count
from sigmasplat.model.mesh import Mesh
from sigmasplat.model.submap import SubmapStore
from sigmasplat.model.tsdf import packed
from sigmasplat.render.view import View
from sigmasplat.slam.fusion import count_keyframes, fuse, fusion_views
from sigmasplat.types import Matrix, Progress

CACHE_BYTES = 64 << 20
"""Of pictures laid out for the fit; the others are read again when drawn."""


def final_map(
    store: SubmapStore,
    anchors: Sequence[Matrix],
    config: Config,
    view: View,
    random: np.random.Generator,
    progress: Progress = lambda done, total: None,
) -> GaussianField:
    """Return the map in the world, of submaps at `anchors` (T_world_submap [4, 4] each), refined through `view`.

    `progress` is told (steps of refinement done, of how many). Memory holds this map, one submap and some pictures.
    Raises SigmaSplatError if there is no submap, one without an anchor, or one of another camera than the view's;
    ConfigError on settings out of range.
    """
    _refuse_misfits(store, anchors, config.final)
    seed = seeded_on_surface if config.final.seed_from == "mesh" else merged
    field = seed(store, anchors, config)
    if not config.final.iterations:
        return field
    on_device = field.to(view.sums.device)
    refine(on_device, Keyframes(store, anchors, view), config, view, random, progress)
    return on_device.to(field.params.device)


def _refuse_misfits(store: SubmapStore, anchors: Sequence[Matrix], final: FinalConfig) -> None:
    """Raise SigmaSplatError or ConfigError on what no final map can be made of."""
    if not 0 < len(store) <= len(anchors):
        raise SigmaSplatError(f"no final map without submaps and their anchors: {len(store)} and {len(anchors)} given")
    count(final.sh_degree)
    for name in ("spacing_m", "sh_every", "prune_every"):
        if not getattr(final, name) > 0:
            raise ConfigError(f"final.{name} must be above 0, found {getattr(final, name)}")


# ---- merging ----


def merged(store: SubmapStore, anchors: Sequence[Matrix], config: Config) -> GaussianField:
    """Join all submaps' splats in the world (anchors: T_world_submap [4, 4]), without doubles (`survivors`)."""
    field, owner = GaussianField.empty(), list[NDArray[np.int64]]()
    for index in range(len(store)):
        part = _in_world(store, anchors, index)
        owner.append(np.full(len(part), index))
        field.append(part)
    unsteady = _log_variance(field) if config.final.uncertainty else None
    keep = survivors(field.means.numpy(), np.concatenate(owner), unsteady, config.final.spacing_m)
    field.keep(torch.from_numpy(keep))
    return field


def _in_world(store: SubmapStore, anchors: Sequence[Matrix], index: int) -> GaussianField:
    """Return a submap's splats in the world, their optimiser state left behind."""
    part = store.load(index).field.moved(torch.from_numpy(anchors[index]))
    return GaussianField(
        part.params, attributes={name: Rows(attribute.params) for name, attribute in part.attributes.items()}
    )


def _log_variance(field: GaussianField) -> NDArray[np.float64]:
    """Return log σ² of each splat [N], mean over the channels."""
    return np.asarray(field.params[:, COLUMNS["log_variances"]].mean(1).double())


def survivors(
    means: NDArray[np.floating],
    owner: NDArray[np.int64],
    unsteady: NDArray[np.float64] | None,
    spacing_m: float,
) -> NDArray[np.bool_]:
    """Tell which splats stay, bool [N], so that each voxel of `spacing_m` keeps those of one submap only.

    means [N, 3] m, world; owner [N]: which submap each is of. It is the submap whose splats there are steadier, by the
    mean of `unsteady` [N] (log σ²); without that, and of equals, the earlier one.
    """
    submaps = int(owner.max(initial=0)) + 1
    _, voxel = np.unique(packed(np.floor(means / spacing_m).astype(np.int64)), return_inverse=True)
    pairs, pair = np.unique(voxel * submaps + owner, return_inverse=True)
    place, score = pairs // submaps, np.zeros(len(pairs))
    if unsteady is not None:
        score += np.bincount(pair, unsteady) / np.bincount(pair)
    order = np.lexsort((pairs % submaps, score, place))
    _, first = np.unique(place[order], return_index=True)
    return np.isin(pair, order[first])


# ---- seeding on the surface ----


def seeded_on_surface(store: SubmapStore, anchors: Sequence[Matrix], config: Config) -> GaussianField:
    """Place splats on the surface that the submaps show, `spacing_m` apart and as large (VarSplat §7).

    anchors: T_world_submap [4, 4] of each submap. Their σ² is the nearest submap splat's, with `final.uncertainty` off
    the initial one. Raises SigmaSplatError if no surface is shown.
    """
    final = config.final
    mesh = fuse(fusion_views(store, anchors), count_keyframes(store), config, weigh=final.uncertainty)
    if not len(mesh.vertices):
        raise SigmaSplatError("the submaps show no surface to seed the final map on; take final.seed_from=submaps")
    points, colors = thinned_vertices(mesh, final.spacing_m)
    log_variances = torch.full((len(points), 3), INITIAL_LOG_VARIANCE)
    if final.uncertainty:
        log_variances = nearest_log_variances(points, store, anchors)
    scales = torch.full((len(points), 3), final.spacing_m)
    return GaussianField.from_values(
        torch.from_numpy(points).float(), scales, torch.from_numpy(colors).float(), log_variances=log_variances
    )


def thinned_vertices(mesh: Mesh, spacing_m: float) -> tuple[Matrix, Matrix]:
    """Return the mean position [M, 3] m and colour [M, 3] of a mesh's vertices in each voxel of `spacing_m`."""
    cells = packed(np.floor(mesh.vertices / spacing_m).astype(np.int64))
    _, cell, counts = np.unique(cells, return_inverse=True, return_counts=True)
    colors = np.full_like(mesh.vertices, 0.5) if mesh.colors is None else mesh.colors
    sums = [np.bincount(cell, column) for column in (*mesh.vertices.T, *colors.T)]
    means = np.stack(sums, 1) / counts[:, None]
    return means[:, :3], means[:, 3:]


def nearest_log_variances(points: Matrix, store: SubmapStore, anchors: Sequence[Matrix]) -> Tensor:
    """Return log σ² [M, 3] of the splat nearest to each point [M, 3] m, of submaps at T_world_submap [4, 4] each."""
    found, distance = torch.full((len(points), 3), INITIAL_LOG_VARIANCE), np.full(len(points), np.inf)
    for index in range(len(store)):
        part = _in_world(store, anchors, index)
        if not len(part):
            continue
        away, which = map(np.asarray, cKDTree(part.means.numpy()).query(points))
        nearer = away < distance
        found[nearer] = part.params[which[nearer], COLUMNS["log_variances"]]
        distance[nearer] = away[nearer]
    return found


# ---- refinement ----


class Keyframes:
    """All keyframes of all submaps where they are in the world; a picture is read from the store when it is asked for.

    anchors: T_world_submap [4, 4] of each submap; `poses`: T_world_camera [4, 4] of each keyframe. Raises
    SigmaSplatError if there is none, or a submap's camera is not the view's.
    """

    def __init__(self, store: SubmapStore, anchors: Sequence[Matrix], view: View) -> None:
        self.store, self.camera = store, view.camera
        self.size = (view.alpha.shape[0], view.alpha.shape[1])
        self.places: list[tuple[int, int]] = []
        self.poses: list[Matrix] = []
        for index in range(len(store)):
            self._add(index, anchors[index])
        if not self.places:
            raise SigmaSplatError("the submaps have no keyframes to refine the final map over")
        self._target = lru_cache(max(1, CACHE_BYTES // (16 * view.alpha.numel())))(self._read)

    def _add(self, index: int, T_world_submap: Matrix) -> None:
        submap = self.store.load(index)
        if submap.camera != self.camera:
            raise SigmaSplatError(f"submap {index} was seen by {submap.camera}, the view is of {self.camera}")
        self.places += [(index, k) for k in range(len(submap.frames))]
        self.poses += [T_world_submap @ T for T in submap.T_submap_camera]

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, i: int) -> Keyframe:
        return Keyframe(i, self._target(i), self.poses[i], fixed=True)

    def _read(self, i: int) -> Target:
        return Target.of_picture(self.store.picture(*self.places[i]), self.camera, self.size)


def refine(
    field: GaussianField,
    keyframes: Keyframes,
    config: Config,
    view: View,
    random: np.random.Generator,
    progress: Progress,
) -> list[float]:
    """Fit the field to keyframes drawn evenly, poses fixed; prune now and then; return each step's loss (no unit).

    Colours gain a degree of view dependence each `sh_every` steps.
    """
    final, mapping, losses = config.final, refinement(config), list[float]()
    drawn = _draw(keyframes, final.iterations, random, progress)
    while (done := len(losses)) < final.iterations:
        until_event = min(every - done % every for every in (final.prune_every, final.sh_every))
        degree = min(final.sh_degree, done // final.sh_every)
        fit = fit_field(field, view, islice(drawn, until_event), mapping, degree=degree)
        losses += fit.losses
        if len(losses) % final.prune_every == 0:
            field.keep(field.opacities > final.prune_opacity)
    progress(final.iterations, final.iterations)
    return losses


def refinement(config: Config) -> MappingConfig:
    """Return mapping's settings as refinement uses them: poses fixed; with `final.uncertainty` off no likelihood."""
    fixed = replace(config.mapping, lr_pose_translation=0.0, lr_pose_rotation=0.0)
    return fixed if config.final.uncertainty else replace(fixed, weight_nll_color=0.0, weight_nll_depth=0.0)


def _draw(
    keyframes: Keyframes, steps: int, random: np.random.Generator, progress: Progress
) -> Iterator[Sequence[Keyframe]]:
    """Draw keyframes evenly, one a step, telling before each how many were drawn."""
    for step in range(steps):
        progress(step, steps)
        yield [keyframes[int(random.integers(len(keyframes)))]]
