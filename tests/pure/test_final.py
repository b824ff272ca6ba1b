"""The final map on plain torch: two submaps before one wall, merged without doubles, seeded anew, refined."""

import itertools
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from constants import changed
from paper_settings import MappingConfig
from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.data.submap import MemoryStore, Submap
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.final import final_map as final
from sigmasplat.final.final_map import final_map, merged, survivors, z_order
from sigmasplat.final.fusion import count_keyframes, fuse, fusion_views
from sigmasplat.final.refinement import KeyframeReader, refine
from sigmasplat.fit.adam import ATTRIBUTE_RATES
from sigmasplat.mapping.densify import largest_weights, prune_by_weight
from sigmasplat.render.reference import ReferenceView
from two_submaps import (
    ANCHORS,
    CAMERA,
    CONFIG,
    LOG_VARIANCES,
    SPACING_M,
    WALL_M,
    color_at,
    config,
    look,
    make_store,
    poses,
    wall,
)


def refined(store: MemoryStore, settings: Config, seed: int = 0) -> GaussianField:
    view = ReferenceView(CAMERA, settings.render)
    return final_map(store, ANCHORS, settings, view, np.random.default_rng(seed)).field


def psnr_of_held(field: GaussianField, true: GaussianField) -> float:
    """Score views between the keyframes, dB, over pixels where the wall is."""
    errors = []
    for submap in (0, 1):
        T = se3.exp(np.array([0.4 * submap - 0.15, -0.02, 0.05, 0.01, 0.02, 0]))
        want, got = look(T, true), look(T, field)
        errors.append(((want.color[want.depth_m > 0] / 255.0 - got.color[want.depth_m > 0] / 255.0) ** 2).ravel())
    return float(-10 * np.log10(np.concatenate(errors).mean()))


# ---- merging ----


@pytest.mark.parametrize("uncertainty", [True, False])
def test_where_submaps_overlap_one_of_them_stays(uncertainty: bool) -> None:
    store = make_store()
    field = merged(store, ANCHORS, config(uncertainty=uncertainty))
    assert float((field.means[:, 2] - WALL_M).abs().max()) < 1e-5, "in the world"
    second = field.params[:, COLUMNS["log_variances"]].mean(1) == LOG_VARIANCES[1]
    x = field.means[:, 0]
    assert second[x > 0.5].all() and not second[x < -0.3].any(), "where there is one submap, all of it stays"
    assert bool(second[(x > -0.05) & (x < 0.25)].all()) is uncertainty, "the steadier one, else the earlier"
    assert len(field) < sum(len(s.field) for s in store.submaps) - 60
    everything = torch.cat([wall(-1.4, 0.4).means, wall(-0.2, 1.6).means])
    away = cKDTree(field.means.numpy()).query(everything.numpy())[0]
    assert away.max() < SPACING_M * np.sqrt(3), "no hole"


@pytest.mark.parametrize("uncertainty", [True, False])
def test_a_room_that_many_submaps_show_is_merged_in_parts_with_the_same_result(
    monkeypatch: pytest.MonkeyPatch, uncertainty: bool
) -> None:
    store, generator, most = MemoryStore(), torch.Generator().manual_seed(2), 0
    for index in range(12):
        part = wall(0.1 * (index % 5) - 1.4, 0.1 * (index % 7) + 0.4)
        part.params += 0.03 * torch.randn(part.params.shape, generator=generator)
        store.save(Submap(index, part, (), np.empty((0, 4, 4)), CAMERA), [])
        most += len(part)
    anchors, joined = [np.eye(4)] * 12, list[int]()
    whole = merged(store, anchors, config(uncertainty=uncertainty))

    def counted(means: np.ndarray, *more: Any) -> np.ndarray:
        joined.append(len(means))
        return survivors(means, *more)

    monkeypatch.setattr(final, "AT_ONCE", 500)
    monkeypatch.setattr(final, "survivors", counted)
    assert torch.equal(merged(store, anchors, config(uncertainty=uncertainty)).params, whole.params)
    assert len(joined) > 3 and max(joined) < most / 2


def test_every_voxel_keeps_exactly_one_submap() -> None:
    rng = np.random.default_rng(1)
    means, owner, unsteady = rng.uniform(-1, 1, (3000, 3)), rng.integers(0, 4, 3000), rng.normal(size=3000)
    for given in (unsteady, None):
        keep = survivors(means, owner, given, 0.25)
        stays: dict[tuple[int, ...], set[int]] = {}
        for i in range(3000):
            voxel = tuple(np.floor(means[i] / 0.25).astype(int))
            here = [j for j in range(3000) if tuple(np.floor(means[j] / 0.25).astype(int)) == voxel] if i < 40 else None
            if here is not None:  # by hand, for some
                score = {o: (np.mean([unsteady[j] for j in here if owner[j] == o]) if given is not None else o)
                         for o in {int(owner[j]) for j in here}}  # fmt: skip
                assert keep[i] == (owner[i] == min(score, key=score.__getitem__))
            stays.setdefault(voxel, set())
            if keep[i]:
                stays[voxel].add(int(owner[i]))
        assert {len(owners) for owners in stays.values()} == {1}


def test_one_submap_is_left_as_it_is() -> None:
    store = MemoryStore()
    whole = make_store()
    store.save(whole.submaps[0], whole.pictures[0])
    store.submaps[0].field.attributes["harmonics"] = Rows(torch.ones(len(store.submaps[0].field), 45))
    field = refined(store, config())
    assert torch.equal(field.params, store.submaps[0].field.params) and set(field.attributes) == {"harmonics"}
    field.params += 1.0
    assert float(store.submaps[0].field.means[:, 2].max()) < 2.0, "the submap's own memory is not touched"


def test_the_z_order_visits_a_cube_of_cells_completely_before_the_next() -> None:
    points = np.random.default_rng(0).uniform(0, 2.56, (500, 3))
    order = z_order(np.concatenate([points, np.zeros((1, 3))]))
    cube = (np.concatenate([points, np.zeros((1, 3))])[order] // 1.28) @ [1, 2, 4]
    assert sorted(order) == list(range(501))
    assert list(cube) == sorted(cube)


# ---- seeding on the surface ----


def test_mesh_seeds_cover_the_surface() -> None:
    field = refined(make_store(), config(seed_from="mesh"))
    x, y, z = field.means.numpy().T
    assert np.abs(z - WALL_M).max() < 0.02 and len(field) > 100
    mesh = fuse(fusion_views(make_store(), ANCHORS), 6, config(), voxel_m=0.01)
    assert cKDTree(field.means.numpy()).query(mesh.vertices)[0].max() < SPACING_M * np.sqrt(3)
    cells = np.floor(field.means.numpy() / SPACING_M).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.9 * len(field), "spacing apart"
    inside = (np.abs(x) < 0.3) & (np.abs(y) < 0.3)
    assert np.abs(field.colors.numpy()[inside] - color_at(x, y)[inside]).mean() < 0.08
    torch.testing.assert_close(field.scales, torch.full_like(field.scales, SPACING_M))
    torch.testing.assert_close(field.opacities, torch.full((len(field),), 0.5))
    assert (field.params[:, COLUMNS["log_variances"]] == -7.0).all()


def test_standpoints_are_the_keyframes_in_field_and_world() -> None:
    store = make_store()
    found = list(fusion_views(store, ANCHORS))
    assert len(found) == count_keyframes(store) == 6
    for at, pose in zip(found, poses(0) + poses(1), strict=True):
        np.testing.assert_allclose(at.T_world_camera, pose, atol=1e-12)
    T_camera_submap = se3.inverse(poses(1)[1]) @ ANCHORS[1]
    np.testing.assert_allclose(found[4].T_camera_field, T_camera_submap, atol=1e-12)
    assert found[4].field is store.submaps[1].field


# ---- refinement ----


@pytest.mark.parametrize("uncertainty", [True, False])
def test_refinement_improves_views_of_keyframes(uncertainty: bool) -> None:
    store, true, told = make_store(spoil=0.15), wall(-1.4, 1.6), list[tuple[int, int]]()
    start = refined(store, config(uncertainty=uncertainty))
    settings, view = config(uncertainty=uncertainty, iterations=30), ReferenceView(CAMERA, CONFIG.render)
    settings = replace(settings, mapping=changed(settings.mapping, lr_colors=0.04, lr_pose_rotation=1.0))
    field = final_map(store, ANCHORS, settings, view, np.random.default_rng(0), lambda *at: told.append(at)).field
    assert psnr_of_held(field, true) > psnr_of_held(start, true) + 3.0
    assert told == [(i, 30) for i in range(31)]
    before, after = (one.params[:, 14:].sort(0).values for one in (start, field))  # refinement orders the rows anew
    likelihood_trained = not torch.equal(before, after)
    assert likelihood_trained is uncertainty, "σ² learns only where it is asked for"
    again = final_map(store, ANCHORS, settings, view, np.random.default_rng(0)).field
    assert torch.equal(again.params, field.params), "the same draw gives the same map"


def test_free_poses_lower_the_loss_and_recover_a_perturbed_keyframe() -> None:
    """One keyframe is off by 8 cm; the splats are right and fixed, so that only its pose can explain its picture."""
    store, away_m = make_store(), 0.08
    true = store.submaps[0].T_submap_camera.copy()
    store.submaps[0].T_submap_camera[1, 0, 3] += away_m
    given, losses, found = store.submaps[0].T_submap_camera[1].copy(), dict[str, list[float]](), {}
    still = {f"lr_{name}": 0.0 for name in COLUMNS}
    for name, rate in (("free", 3e-2), ("fixed", 0.0)):
        settings = config(iterations=60, lr_pose_translation=rate, lr_decay=0.03)
        settings = replace(settings, mapping=changed(settings.mapping, **still))
        view = ReferenceView(CAMERA, settings.render)
        keyframes, field = KeyframeReader(store, ANCHORS, view), wall(-1.4, 1.6)
        losses[name] = refine(field, keyframes, settings, view, np.random.default_rng(0), lambda done, total: None)
        found[name] = keyframes.poses_in(ANCHORS)[0]
    assert sum(losses["free"][-6:]) < sum(losses["fixed"][-6:])
    np.testing.assert_allclose(found["fixed"][1], given, atol=1e-12)
    assert abs(found["free"][1] - true[1])[0, 3] < away_m / 4
    np.testing.assert_allclose(found["free"][0], true[0], atol=1e-12, err_msg="the first keyframe fixes the gauge")


@pytest.mark.slow
def test_a_pose_comes_to_rest_at_the_reach_and_the_first_one_stays() -> None:
    """The picture of one keyframe asks for a pose 8 cm away; the tracked pose holds it at a distance of the reach."""
    store, reach_m = make_store(), 0.01
    store.submaps[0].T_submap_camera[1, 0, 3] += 0.08
    given = poses(0)
    given[1][0, 3] += 0.08
    still = {f"lr_{name}": 0.0 for name in COLUMNS}
    moved_m = {}
    for reach in (0.0, reach_m, 1e-9):
        settings = config(iterations=240, lr_pose_translation=3e-3, pose_reach_m=reach)
        settings = replace(settings, mapping=changed(settings.mapping, **still))
        view = ReferenceView(CAMERA, settings.render)
        keyframes = KeyframeReader(store, ANCHORS, view)
        refine(wall(-1.4, 1.6), keyframes, settings, view, np.random.default_rng(0), lambda done, total: None)
        found = keyframes.poses_in(ANCHORS)[0]
        moved_m[reach] = float(np.linalg.norm((found[1] - given[1])[:3, 3]))
        np.testing.assert_allclose(found[0], given[0], atol=1e-12, err_msg="the first keyframe fixes the gauge")
    assert moved_m[0.0] > 0.06, "without a limit the pose goes where its picture asks"
    assert 0.3 * reach_m < moved_m[reach_m] < 1.5 * reach_m
    assert moved_m[1e-9] < 1e-9, "a reach far below the rate holds the pose"


def test_epochs_use_every_keyframe_equally_often() -> None:
    keyframes, random = (
        KeyframeReader(make_store(), ANCHORS, ReferenceView(CAMERA, CONFIG.render)),
        np.random.default_rng(0),
    )
    drawn = [keyframes.draw("epochs", random) for _ in range(12)]
    assert sorted(drawn[:6]) == sorted(drawn[6:]) == list(range(6)) and drawn[:6] != drawn[6:]


def test_splats_that_no_keyframe_shows_are_removed() -> None:
    """A second wall hides behind the first."""
    view, hidden = ReferenceView(CAMERA, CONFIG.render), wall(-0.5, 0.5)
    keyframes = KeyframeReader(make_store(), ANCHORS, view)
    hidden.params[:, 2] += 0.5
    front = wall(-1.4, 1.6)
    front.params[:, COLUMNS["opacity_logits"]] = 8.0
    front.params[:, COLUMNS["log_scales"]] += 0.5
    field = front.copy_to(torch.device("cpu"))
    field.append(hidden)
    weights = largest_weights(field, view, keyframes)
    prune_by_weight(field, view, keyframes, 0.5)
    kept = torch.isin(torch.arange(len(weights)), field.ids)
    assert float(field.means[:, 2].max()) < WALL_M + 0.1 and len(field) > 50
    assert bool((weights[kept] >= 0.5).all()) and bool((weights[~kept] < 0.5).all())


def test_a_time_budget_ends_refinement_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the clock takes a hundredth of a second."""
    ticks = itertools.count(0.0, 0.01)
    monkeypatch.setattr("sigmasplat.final.refinement.time.perf_counter", lambda: next(ticks))
    told, settings = list[tuple[int, int]](), config(iterations=1000, seconds=3.0, lr_decay=0.1)
    view = ReferenceView(CAMERA, settings.render)
    made = final_map(make_store(), ANCHORS, settings, view, np.random.default_rng(0), lambda *at: told.append(at))
    assert 10 < made.steps < 100
    assert told == sorted(told) and told[-1] == (1000, 1000) and told[-2][0] > 900, "progress follows the clock"


def test_degrees_grow_and_faded_splats_go(monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_store()
    store.submaps[0].field.params[:5, 10] = -8.0
    store.submaps[1].field.params[-5:, 10] = -8.0
    used = []

    def fit(
        field: GaussianField, view: object, order: object, mapping: MappingConfig, degree: int, schedule: object
    ) -> object:
        assert schedule is None, "the rate of the means stays the same"
        steps = len(list(order))  # type: ignore[call-overload]
        used.append((steps, degree, len(field)))
        return type("Fit", (), {"losses": [0.0] * steps})()

    monkeypatch.setattr("sigmasplat.final.refinement.fit_field", fit)
    full = len(refined(store, config()))
    field = refined(store, config(iterations=25, sh_degree=2, sh_every=6, prune_every=10))
    assert [(steps, degree) for steps, degree, _ in used] == [(6, 0), (4, 1), (2, 1), (6, 2), (2, 2), (4, 2), (1, 2)]
    assert [n for *_, n in used] == [full] * 2 + [full - 10] * 5 and len(field) == full - 10


def test_the_rate_of_the_means_falls_to_its_last_value_across_pruning(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learning rates of all steps fall evenly in their logarithm, whatever interrupts the steps."""
    used: list[float] = []

    def fit(field: GaussianField, view: object, order: object, mapping: MappingConfig, **more: object) -> object:
        rates = [rates.per_column for _, rates in zip(order, more["schedule"], strict=False)]  # type: ignore[call-overload]
        used.extend(float(columns[COLUMNS["means"]][0]) for columns in rates)
        assert all(float(columns[COLUMNS["colors"]][0]) == pytest.approx(2.5e-3) for columns in rates)
        return type("Fit", (), {"losses": [0.0] * len(rates)})()

    monkeypatch.setattr("sigmasplat.final.refinement.fit_field", fit)
    refined(make_store(), config(iterations=25, prune_every=10, sh_every=7, lr_means_last=1.6e-6))
    assert used[0] == pytest.approx(1e-4) and used[-1] == pytest.approx(1.6e-6)
    assert np.allclose(np.diff(np.log(used)), np.log(1.6e-2) / 24, rtol=1e-3)


@pytest.mark.parametrize(("own", "first"), [(0.0, 8 * 5e-3), (0.02, 0.02)])
def test_sizes_can_have_a_rate_of_their_own(monkeypatch: pytest.MonkeyPatch, own: float, first: float) -> None:
    """It replaces that of mapping times the factor, and decays as the others do."""
    used: dict[str, list[float]] = {"log_scales": [], "quats": []}

    def fit(field: GaussianField, view: object, order: object, mapping: MappingConfig, **more: object) -> object:
        rates = [rates.per_column for _, rates in zip(order, more["schedule"], strict=False)]  # type: ignore[call-overload]
        for name, found in used.items():
            found.extend(float(columns[COLUMNS[name]][0]) for columns in rates)
        return type("Fit", (), {"losses": [0.0] * len(rates)})()

    monkeypatch.setattr("sigmasplat.final.refinement.fit_field", fit)
    refined(make_store(), config(iterations=20, prune_every=7, lr_factor=8.0, lr_decay=0.1, lr_log_scales=own))
    assert used["log_scales"][0] == pytest.approx(first) and used["log_scales"][-1] == pytest.approx(0.1 * first)
    assert used["quats"][0] == pytest.approx(8 * MappingConfig().lr_quats)
    assert np.allclose(np.diff(np.log(used["log_scales"])), np.diff(np.log(used["quats"])), rtol=1e-3)


def around(angle: float) -> np.ndarray:
    """Return T_world_camera of a camera on an arc about the wall's middle, looking at it."""
    middle = np.eye(4)
    middle[2, 3] = WALL_M
    return middle @ se3.exp(np.array([0, 0, 0, 0, angle, 0])) @ se3.inverse(middle)


def test_view_dependent_colour_is_learned_in_refinement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of a wall that is brighter the more it is seen from the right: harmonic 3, −x, has to say so."""
    shiny, plain, path = wall(-1.4, 1.6), wall(-1.4, 1.6), [around(a) for a in np.linspace(-0.8, 0.8, 5)]
    shiny.attributes["harmonics"] = Rows(torch.zeros(len(shiny), 45))
    shiny.attributes["harmonics"].params[:, 6:9] = 0.5
    store = MemoryStore()
    store.save(Submap(0, plain, (0, 1, 2, 3, 4), np.array(path), CAMERA), [look(pose, shiny) for pose in path])
    monkeypatch.setitem(ATTRIBUTE_RATES, "harmonics", ("colors", 1.0))  # 40 steps are few at a twentieth
    errors = []
    for degree in (0, 1):
        settings = config(iterations=40, sh_degree=degree, sh_every=1)
        only_colors = changed(settings.mapping, lr_colors=0.02, lr_means=0.0, lr_opacity_logits=0.0)
        field = refined(store, replace(settings, mapping=only_colors))
        off = [look(around(a), field).color / 255.0 - look(around(a), shiny).color / 255.0 for a in (-0.6, 0.6)]
        errors.append(np.abs(off).mean())
    learned = field.attributes["harmonics"].params[:, :9].reshape(-1, 3, 3).mean((0, 2))
    assert errors[1] < 0.7 * errors[0], errors
    assert learned[2] > 0.1 and learned[2] > 3 * learned[:2].abs().max(), learned


def test_pictures_are_read_when_drawn_and_kept_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    store, read = make_store(), list[tuple[int, int]]()
    monkeypatch.setattr(store, "picture", lambda s, k: read.append((s, k)) or store.pictures[s][k])
    view = ReferenceView(CAMERA, CONFIG.render)
    monkeypatch.setattr("sigmasplat.final.refinement.CACHE_BYTES", 2 * 16 * 20 * 15)
    keyframes = KeyframeReader(store, ANCHORS, view)
    assert len(keyframes) == 6 and not read
    for i in (0, 5, 0, 5, 3, 0):
        found = keyframes[i]
        np.testing.assert_allclose(found.T_world_camera, poses(i // 3)[i % 3], atol=1e-12)
        np.testing.assert_array_equal(found.target.depth_image.numpy(), store.pictures[i // 3][i % 3].depth_m)
    assert read == [(0, 0), (1, 2), (1, 0), (0, 0)], "two fit: the third drives out the one not asked for longest"


# ---- bad input ----


def test_submaps_without_a_surface_are_refused_as_seeds() -> None:
    blind = deepcopy(make_store())
    for submap in blind.submaps:
        submap.field.params[:, 10] = -9.0
    with pytest.raises(SigmaSplatError, match="have no surface"):
        refined(blind, config(seed_from="mesh"))


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"sh_degree": 4}, r"final\.sh_degree must be between 0 and 3, found 4"),
        ({"iterations": -1}, r"final\.iterations must be at least 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        refined(make_store(), config(**settings))
