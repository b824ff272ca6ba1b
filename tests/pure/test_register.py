"""Registration on small submaps of the built-in room, whose true places are known; and its arithmetic."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from constants import changed
from paper_settings import RegistrationConfig, RenderConfig, SeedConfig, TrackingConfig, paper_settings
from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.fit.target import Target
from sigmasplat.graph import localisations, registration
from sigmasplat.graph.candidates import Candidate, SubmapPair
from sigmasplat.graph.localisations import Localisation
from sigmasplat.graph.registration import Registrar, Registration, drift_between
from sigmasplat.mapping.seeding import make_splats
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.tracking import drift
from sigmasplat.tracking.drift import floor, hop_errors
from sigmasplat.tracking.features import Extractor, Features
from sigmasplat.types import completed
from small_room import frame_at, walk

Matrix = NDArray[np.float64]

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SEEDS = SeedConfig(scale_from="pixel", density=1.0, scale_factor=0.8)
CONFIG = paper_settings(
    tracking=TrackingConfig(method="align", align_weight_color=0.1),
    registration=RegistrationConfig(iterations=10, lr_translation=1e-3, lr_rotation=1e-3, tau=10.0, judges=True),
)
TO_KEYFRAME = replace(CONFIG, registration=changed(CONFIG.registration, to_keyframe=True))


def piece(store: MemoryStore, frames: Sequence[int], brighter: float = 1.0) -> Submap:
    """Add a submap of some frames, every pixel a splat at its true place, and what those frames saw."""
    truth = walk().truth().T_world_camera
    T_submap_camera = np.stack([se3.inverse(truth[frames[0]]) @ truth[i] for i in frames])
    field, pictures = GaussianField.empty(), []
    for i, T in zip(frames, T_submap_camera, strict=True):
        seen = frame_at(i)
        target = Target.of(replace(seen, color=np.clip(seen.color * brighter, 0, 1)), (120, 160))
        field.append(make_splats(target, T, seen.depth_m > 0, 1.0, field, SEEDS))
        pictures.append(target.picture())
    submap = Submap(len(store), field, tuple(frames), T_submap_camera, walk().camera)
    store.save(submap, pictures)
    return submap


def registered(
    a: Sequence[int],
    b: Sequence[int],
    error: Matrix,
    brighter: float = 1.0,
    config: Config = CONFIG,
    unread: Sequence[slice] = (),
) -> tuple[Registration, Matrix]:
    """Register submaps of frames a and b, told a T_a_b that is wrong by `error`; return the verdict and the truth.

    unread: columns without readings in the recorded images of each submap; its map has all splats.
    """
    store = MemoryStore()
    ours, theirs = piece(store, a), piece(store, b, brighter)
    for pictures, columns in zip(store.pictures, unread, strict=False):
        pictures[:] = [_without_readings(picture, columns) for picture in pictures]
    truth = walk().truth().T_world_camera
    T_a_b = se3.inverse(truth[a[0]]) @ truth[b[0]]
    pair = SubmapPair(Candidate(0, 0, 1, 0, 1.0, 1.0), (0, 1), (0, 1))
    view = make_view("cpu", walk().camera, RenderConfig())
    return completed(Registrar(config, store, view).register(pair, ours, theirs, error @ T_a_b)), T_a_b


def _without_readings(picture: Picture, columns: slice) -> Picture:
    depth_m = picture.depth_m.copy()
    depth_m[:, columns] = 0.0
    return replace(picture, depth_m=depth_m)


def off(found: Matrix, truth: Matrix) -> tuple[float, float]:
    E = se3.inverse(truth) @ found
    return float(np.linalg.norm(E[:3, 3])), float(np.rad2deg(se3.rotation_angle(E[:3, :3])))


@pytest.mark.parametrize("brighter", [1.0, 0.85])
def test_submaps_of_one_place_find_each_other_from_afar_and_in_another_light(brighter: float) -> None:
    error = se3.exp(np.array([0.1, -0.05, 0.05, 0.03, 0.06, -0.02]))
    found, truth = registered((0, 5), (3, 8), error, brighter)
    assert found.accepted, found.reason
    assert found.localised == 4
    metres, degrees = off(found.T_a_b, truth)
    assert metres < 0.01
    assert degrees < 0.3
    assert found.overlap > 0.8
    assert np.linalg.eigvalsh(found.information)[0] > 0.0


def test_the_images_that_submaps_render_register_them_without_the_recorded_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(MemoryStore, "picture", None)
    config = replace(CONFIG, registration=changed(CONFIG.registration, target="rendered"))
    error = se3.exp(np.array([0.1, -0.05, 0.05, 0.03, 0.06, -0.02]))
    found, truth = registered((0, 5), (3, 8), error, config=config)
    assert found.accepted, found.reason
    metres, degrees = off(found.T_a_b, truth)
    assert metres < 0.01 and degrees < 0.3


def test_a_loop_that_maps_show_but_no_recorded_image_is_refused() -> None:
    """The images of one submap have readings on the left, those of the other one on the right."""
    error = se3.exp(np.array([0.02, -0.01, 0.01, 0.01, 0.01, -0.01]))
    to_keyframe = TO_KEYFRAME
    halves = slice(0, 75), slice(85, 160)
    by_maps, _ = registered((0, 5), (3, 8), error, unread=halves)
    by_images, _ = registered((0, 5), (3, 8), error, config=to_keyframe, unread=halves)
    assert by_maps.accepted
    assert not by_images.accepted and "no image does" in by_images.reason
    whole, truth = registered((0, 5), (3, 8), error, config=to_keyframe, unread=(slice(0, 75), slice(0, 75)))
    assert whole.accepted and off(whole.T_a_b, truth)[0] < 0.005


def test_a_submap_whose_splats_are_too_near_does_not_bias_the_pose_relative_to_its_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All surfaces of both maps are 3 % too near, as those of a young map; the recorded images are exact."""
    seeded = make_splats

    def too_near(target: Target, T: Matrix, *more: Any) -> GaussianField:
        field = seeded(target, T, *more)
        camera = torch.tensor(T[:3, 3], dtype=torch.float32)
        field.params[:, COLUMNS["means"]] = camera + 0.97 * (field.means - camera)
        return field

    monkeypatch.setitem(globals(), "make_splats", too_near)
    error = se3.exp(np.array([0.02, -0.01, 0.01, 0.01, 0.01, -0.01]))
    to_map, truth = registered((0, 5), (3, 8), error)
    to_keyframe, _ = registered((0, 5), (3, 8), error, config=TO_KEYFRAME)
    assert to_keyframe.accepted and off(to_keyframe.T_a_b, truth)[0] < 0.005
    assert off(to_map.T_a_b, truth)[0] > 0.01  # if it is not refused: that hangs on rounding


def test_a_pose_relative_to_a_keyframe_needs_no_descent() -> None:
    error = se3.exp(np.array([0.02, -0.01, 0.01, 0.01, 0.01, -0.01]))
    found = [
        registered((0, 5), (3, 8), error, config=TO_KEYFRAME.changed(registration={"iterations": n}))[0]
        for n in (0, 50)
    ]
    assert all(each.accepted and each.localised == 4 for each in found)
    assert np.array_equal(found[0].T_a_b, found[1].T_a_b)


def test_what_is_known_before_does_not_matter_where_the_views_are_alike() -> None:
    found, truth = registered((0, 5), (2, 6), se3.exp(np.array([3.0, 1.0, 0.0, 0.0, 0.0, 2.0])))
    assert found.accepted, found.reason
    assert off(found.T_a_b, truth)[0] < 0.02


class Counting:
    """An extractor that counts in how many images it looks for features."""

    def __init__(self) -> None:
        self.inner, self.images = Extractor(), 0

    def find(self, gray: NDArray[np.uint8], camera: Camera) -> Features:
        self.images += 1
        return self.inner.find(gray, camera)

    def match(self, a: Features, b: Features) -> NDArray[np.int64]:
        return self.inner.match(a, b)


def test_features_guess_the_pose_and_are_found_once_per_image_in_slices_of_their_own() -> None:
    store, counting = MemoryStore(), Counting()
    ours, theirs = piece(store, range(0, 12, 6)), piece(store, range(3, 15, 6))
    truth = walk().truth().T_world_camera
    guesses = Registrar(Config(), store, cast(View, None), cast(Extractor, counting)).guesses_by_features
    for k, frame in enumerate(ours.frames):
        for _ in (slices := guesses(ours, k, theirs, (0, 1))):
            before = counting.images
            next(slices, None)
            assert counting.images <= before + 1, "one image in a slice"
        for found in completed(guesses(ours, k, theirs, (0, 1))):
            apart_m, turned_deg = off(found, se3.inverse(truth[frame]) @ truth[theirs.frames[0]])
            assert apart_m < 0.03 and turned_deg < 1.0
    assert len(completed(guesses(ours, 0, theirs, (0, 1)))) == 2
    assert counting.images == 4
    assert completed(Registrar(Config(), store, cast(View, None)).guesses_by_features(ours, 0, theirs, (0, 1))) == []


def test_submaps_of_different_places_are_refused_and_left_where_they_are() -> None:
    known = np.eye(4)
    found, truth = registered((0, 5), (100, 105), known)
    assert not found.accepted
    assert found.reason
    assert np.allclose(found.T_a_b, truth)


def localisation(T_a_b: Matrix, residual: float = 0.1, covariance: Matrix | None = None) -> Localisation:
    return Localisation(T_a_b, residual, np.eye(6) * 1e-6 if covariance is None else covariance, 1.0, 1.0)


def test_one_stray_localisation_is_left_out() -> None:
    near = [localisation(se3.exp(np.full(6, 0.01 * k))) for k in range(3)]
    stray = localisation(se3.exp(np.array([1.0, 0, 0, 0, 0, 0.0])), residual=0.01)
    agreed = localisations.consensus([stray, *near], np.zeros(3), 0.1, 0.1)
    assert len(agreed) == 3
    assert stray not in agreed


def test_a_turn_counts_where_the_keyframe_is_not_at_the_origin() -> None:
    turn = localisation(se3.exp(np.array([0.0, 0, 0, 0, 0, 0.05])))
    point = np.array([4.0, 0.0, 0.0])
    assert localisations.differs(turn.T_a_b, np.eye(4), point) == pytest.approx((0.2, 0.05), abs=1e-3)
    assert len(localisations.consensus([turn, localisation(np.eye(4))], point, 0.1, 0.1)) == 1


def test_the_mean_leans_towards_the_smaller_residual() -> None:
    far = np.eye(4)
    far[:3, 3] = [0.03, 0.0, 0.0]
    mean = localisations.combined([localisation(np.eye(4), 0.1), localisation(far, 0.2)])
    assert mean[0, 3] == pytest.approx(0.01)
    turns = [localisation(se3.exp(np.array([0, 0, 0, 0, 0, angle])), 0.1) for angle in (0.1, 0.3)]
    assert np.allclose(se3.log_rotation(localisations.combined(turns)[:3, :3]), [0, 0, 0.2])


def test_turning_a_localisation_round_carries_its_covariance() -> None:
    random = np.random.default_rng(0)
    T = se3.exp(random.normal(0, 0.5, 6))
    half = np.diag([3e-3, 1e-3, 2e-3, 1e-3, 2e-3, 3e-3])
    draws = se3.exp_stack(random.standard_normal((20_000, 6)) @ half)
    drawn = np.cov(se3.log_stack(se3.inverse(draws @ T) @ T).T)
    turned = localisations.inverted(localisation(T, covariance=half @ half.T))
    scale = np.sqrt(np.diag(drawn))
    assert np.allclose(turned.T_a_b, se3.inverse(T))
    assert np.abs((turned.covariance - drawn) / np.outer(scale, scale)).max() < 0.04


def test_disagreement_costs_information() -> None:
    close = [localisation(np.eye(4)), localisation(np.eye(4))]
    apart = [localisation(se3.exp(np.array([s * 0.03, 0, 0, 0, 0, 0.0]))) for s in (-1.0, 1.0)]
    sure, unsure = (localisations.mean_covariance(found, np.eye(4)) for found in (close, apart))
    assert unsure[0, 0] == pytest.approx(sure[0, 0] + 0.03**2)
    assert sure[0, 0] == pytest.approx(1e-6 + floor()[0, 0])


def test_the_stated_error_grows_with_the_motion_between_the_images(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = (0, 1), (15, 20)
    with_motion, _ = registered(a, b, np.eye(4))
    monkeypatch.setattr(drift, "BIAS", 0.0)
    without, _ = registered(a, b, np.eye(4))
    more = np.subtract(*(np.linalg.inv(found.information) - found.drift for found in (with_motion, without)))
    truth = walk().truth().T_world_camera
    nearest = [(0, 15), (1, 15), (15, 1), (20, 1)]  # each keyframe is localised, the other submap's nearest one
    turned_rad = [se3.rotation_angle(truth[i][:3, :3].T @ truth[j][:3, :3]) for i, j in nearest]
    assert np.linalg.eigvalsh(more)[0] > 0.0
    assert np.trace(more[3:, 3:]) == pytest.approx(3 * np.mean(np.square(turned_rad)) * 0.02**2, rel=0.05)
    assert np.trace(more[:3, :3]) > 3 * 0.02**2 * np.linalg.norm(truth[15][:3, 3] - truth[1][:3, 3]) ** 2


def test_the_stated_error_contains_the_drift_of_both_submaps_up_to_the_compared_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is what T_a_b scatters by if the motion between the two keyframes is known and those to them are drawn."""
    found, truth = registered((0, 1), (15, 20), np.eye(4))
    a, b = (piece(MemoryStore(), frames) for frames in ((0, 1), (15, 20)))
    np.testing.assert_allclose(found.drift, drift_between(a, b, found.keyframes, found.T_a_b, 1.0))
    assert np.linalg.eigvalsh(np.linalg.inv(found.information) - found.drift)[0] > 0.0

    monkeypatch.setattr(drift, "BIAS", 0.0)
    random, count = np.random.default_rng(3), 20_000
    hops = se3.exp_stack(random.normal(0, 0.2, (5, 6)))
    chain = np.stack([*accumulate(hops, np.matmul, initial=np.eye(4))])
    a, b = replace(a, T_submap_camera=chain), replace(b, T_submap_camera=chain[::-1] @ se3.inverse(chain[5]))
    measured = se3.inverse(a.T_submap_camera[3]) @ truth @ b.T_submap_camera[2]
    roots = np.sqrt(np.diag(hop_errors()))
    drawn_a, drawn_b = (np.repeat(np.eye(4)[None], count, 0) for _ in range(2))
    for submap, drawn, last in ((a, drawn_a, 3), (b, drawn_b, 2)):
        for k in range(1, last + 1):
            hop = se3.inverse(submap.T_submap_camera[k - 1]) @ submap.T_submap_camera[k]
            drawn[:] = drawn @ hop @ se3.exp_stack(roots * random.standard_normal((count, 6)))
    scatter = np.cov(se3.log_stack(drawn_a @ measured @ se3.inverse(drawn_b) @ se3.inverse(truth)).T)
    stated = drift_between(a, b, (3, 2), truth, 1.0)
    scale = np.sqrt(np.diag(stated))
    assert np.abs((stated - scatter) / np.outer(scale, scale)).max() < 0.04
    assert not drift_between(a, b, (0, 0), truth, 1.0).any()


def test_overlap_is_the_larger_share_of_splats_with_a_neighbour() -> None:
    store = MemoryStore()
    whole, part = piece(store, (0,)), piece(store, (0,))
    part.field.keep(part.field.means[:, 0] > 0)
    assert registration.shared(whole, part, np.eye(4), 0.02) == 1.0
    away = np.eye(4)
    away[:3, 3] = [0.0, 0.0, 9.0]
    assert registration.shared(whole, part, away, 0.02) == 0.0
    assert (
        registration.shared(whole, Submap(2, GaussianField.empty(), (), np.zeros((0, 4, 4)), whole.camera), away, 1.0)
        == 0.0
    )
