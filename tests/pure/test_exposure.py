"""Exposure of keyframes: colours go to the map and back, a known exposure is found, refinement separates it from the
map, and frames between keyframes get an interpolated one."""

import numpy as np
import pytest
import torch

import two_submaps as room
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import NEUTRAL, between, centred, exposed, unexposed
from sigmasplat.data.frame import Frame
from sigmasplat.data.poses import Place
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.final.final_map import FinalMap, final_map
from sigmasplat.final.stores import RefinedStore
from sigmasplat.fit.pose import fit_exposure
from sigmasplat.fit.target import Target
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.view_scores import scored_view
from sigmasplat.render import render
from sigmasplat.render.reference import ReferenceView
from sigmasplat.types import Matrix

GAINS = (1.0, 0.7, 1.2, 0.8, 1.15, 0.9)
EXPOSURES = np.array([[[gain, 0.02 * k], [gain, 0.0], [1.05 * gain, -0.01 * k]] for k, gain in enumerate(GAINS)])


def test_colours_return_from_an_exposure_and_stay_in_range() -> None:
    color = np.random.default_rng(0).uniform(0.2, 0.6, (4, 5, 3)).astype(np.float32)
    for exposure in EXPOSURES:
        np.testing.assert_allclose(unexposed(exposed(color, exposure), exposure), color, atol=1e-6)
    assert exposed(color, np.array([[9.0, 0.0]] * 3)).max() == 1.0 and unexposed(color, EXPOSURES[0] + 1).min() == 0.0
    np.testing.assert_array_equal(exposed(color, NEUTRAL), color)


def test_centred_exposures_describe_the_same_images_of_another_map() -> None:
    """If the map takes over the mean exposure, each image stays what it is."""
    gain, offset = np.exp(np.log(EXPOSURES[..., 0]).mean(0)), EXPOSURES[..., 1].mean(0)
    color = np.random.default_rng(1).uniform(0.3, 0.5, (7, 3)).astype(np.float32)
    other = (color * gain + offset).astype(np.float32)
    for before, after in zip(EXPOSURES, centred(EXPOSURES), strict=True):
        np.testing.assert_allclose(exposed(other, after), exposed(color, before), atol=1e-6)
    np.testing.assert_allclose(np.log(centred(EXPOSURES)[..., 0]).mean(0), 0.0, atol=1e-12)
    np.testing.assert_allclose(centred(centred(EXPOSURES))[..., 0], centred(EXPOSURES)[..., 0], atol=1e-12)


def test_exposures_between_frames_are_interpolated_and_held_at_the_ends() -> None:
    found = between(np.array([2, 6]), EXPOSURES[:2], np.array([0, 2, 3, 6, 9]))
    np.testing.assert_allclose(found[:2], [EXPOSURES[0]] * 2)
    np.testing.assert_allclose(found[2], 0.75 * EXPOSURES[0] + 0.25 * EXPOSURES[1])
    np.testing.assert_allclose(found[3:], [EXPOSURES[1]] * 2)
    np.testing.assert_array_equal(between(np.array([], int), np.empty((0, 3, 2)), np.array([4])), [NEUTRAL])


def view_and_target(recorded: np.ndarray) -> tuple[ReferenceView, Target]:
    """Render the wall; return the view and a target with its depth and these colours."""
    view, field = ReferenceView(room.CAMERA, room.CONFIG.render), room.wall(-1.4, 1.6)
    view.forward(field.params, np.eye(4))
    depth_m = np.full(recorded.shape[:2], room.WALL_M, np.float32)
    target = Target.of(Frame(0, 0.0, recorded, depth_m, room.CAMERA), (view.alpha.shape[0], view.alpha.shape[1]))
    return view, target


def test_a_known_exposure_is_found_in_spite_of_wrong_pixels() -> None:
    rendered = render(room.wall(-1.4, 1.6), room.CAMERA, torch.eye(4), options=room.CONFIG.render, backend="reference")
    color, exposure = rendered.color.numpy(), np.array([[0.9, 0.03], [1.1, -0.02], [1.0, 0.05]])
    recorded = exposed(color, exposure)
    recorded[3:6, 4:9] = 0.5  # something that the map does not show
    found = fit_exposure(*view_and_target(recorded))
    errors = np.abs(exposed(color, found) - exposed(color, exposure)).mean((0, 1))
    neutral = np.abs(color - exposed(color, exposure)).mean((0, 1))
    assert (errors < 0.35 * neutral).all()


def test_an_image_without_usable_pixels_has_a_neutral_exposure() -> None:
    np.testing.assert_array_equal(fit_exposure(*view_and_target(np.ones((15, 20, 3), np.float32))), NEUTRAL)


def exposed_store() -> MemoryStore:
    """Return the two submaps of `test_final`, each keyframe recorded with another exposure."""
    store = room.make_store()
    for s, pictures in enumerate(store.pictures):
        for k, picture in enumerate(pictures):
            color = np.rint(255 * exposed(picture.unit_color, EXPOSURES[3 * s + k])).astype(np.uint8)
            pictures[k] = Picture(color, picture.depth_m)
    return store


def made(exposure: bool, iterations: int = 150) -> FinalMap:
    settings = room.config(iterations=iterations, lr_factor=4.0, exposure=exposure)
    view = ReferenceView(room.CAMERA, settings.render)
    return final_map(exposed_store(), room.ANCHORS, settings, view, np.random.default_rng(0))


@pytest.mark.slow
def test_refinement_separates_exposures_from_the_map() -> None:
    """The map keeps one colour per surface, and the images are nearer to it in their fitted exposures."""
    fitted, plain = made(exposure=True), made(exposure=False)
    assert plain.keyframe_exposures is None and fitted.keyframe_exposures is not None
    found = np.concatenate(fitted.keyframe_exposures)
    assert np.corrcoef(found[:, 1, 0] * 0.5 + found[:, 1, 1], centred(EXPOSURES)[:, 1, 0])[0, 1] > 0.9
    errors = {"fitted": list[float](), "plain": list[float]()}
    for s, pictures in enumerate(exposed_store().pictures):
        for k, picture in enumerate(pictures):
            T = room.poses(s)[k]
            for name, final, exposure in (("fitted", fitted, found[3 * s + k]), ("plain", plain, NEUTRAL)):
                color = exposed(room.look(T, final.field).unit_color, exposure)
                errors[name].append(psnr(color, picture.unit_color, picture.depth_m > 0))
    assert np.mean(errors["fitted"]) > np.mean(errors["plain"]) + 3.0


def test_two_refinements_with_exposures_and_moving_poses_have_the_same_bytes() -> None:
    settings = room.config(
        iterations=40, prune_every=7, exposure=True, lr_pose_translation=2e-3, lr_pose_rotation=1e-3,
        pose_reach_m=4e-3, order="epochs", lr_decay=0.1,
    )  # fmt: skip
    view = ReferenceView(room.CAMERA, settings.render)
    one, two = (final_map(exposed_store(), room.ANCHORS, settings, view, np.random.default_rng(0)) for _ in range(2))
    assert torch.equal(one.field.params, two.field.params) and one.steps == two.steps == 40
    assert one.keyframe_exposures is not None and two.keyframe_exposures is not None
    np.testing.assert_array_equal(np.concatenate(one.keyframe_exposures), np.concatenate(two.keyframe_exposures))
    assert one.keyframe_poses is not None and two.keyframe_poses is not None
    np.testing.assert_array_equal(one.keyframe_poses, two.keyframe_poses)
    assert not np.array_equal(one.keyframe_poses[1], room.make_store().submaps[1].T_submap_camera), "poses have moved"


def test_the_final_maps_store_has_images_in_its_exposure() -> None:
    """Probe views get the exposure between their keyframes."""
    store, picture = MemoryStore(), room.make_store().pictures[0][0]
    records = [Picture(np.rint(255 * exposed(picture.unit_color, e)).astype(np.uint8), picture.depth_m)
               for e in (EXPOSURES[0], EXPOSURES[1], 0.5 * (EXPOSURES[0] + EXPOSURES[1]))]  # fmt: skip
    T: Matrix = np.stack([np.eye(4)] * 2)
    submap = Submap(0, room.wall(-1.0, 1.0), (0, 4), T, room.CAMERA, (2,), T[:1])
    store.save(submap, records[:2], records[2:])
    seen = RefinedStore(store, None, [EXPOSURES[:2]])
    for found in (seen.picture(0, 0), seen.picture(0, 1), seen.probe(0, 0)):
        assert np.abs(found.color.astype(int) - picture.color).max() <= 2
        np.testing.assert_array_equal(found.depth_m, picture.depth_m)


def test_frames_get_the_exposure_between_their_keyframes() -> None:
    """Keyframes are the rows 0, 3 and 5; the submap of row 5 is not in the final map."""
    known = ((0, 0), (0, 0), (0, 0), (0, 1), (0, 1), (1, 0))
    atlas = Atlas()
    for submap, keyframe in known:
        atlas.places.append(Place(submap, keyframe, np.eye(4)))
    atlas.exposures = {0: EXPOSURES[:2]}
    found = atlas.frame_exposures()
    np.testing.assert_allclose(found[[0, 3, 4, 5]], EXPOSURES[[0, 1, 1, 1]])
    np.testing.assert_allclose(found[1], EXPOSURES[0] + (EXPOSURES[1] - EXPOSURES[0]) / 3)


def test_views_are_scored_in_their_exposure_and_in_that_of_the_map() -> None:
    field = room.wall(-1.4, 1.6)
    rendered = render(field, room.CAMERA, torch.eye(4), options=room.CONFIG.render, backend="reference")
    depth_m = np.full((15, 20), room.WALL_M, np.float32)
    frame = Frame(0, 0.0, exposed(rendered.color.numpy(), EXPOSURES[1]), depth_m, room.CAMERA)
    scores = scored_view(frame, rendered, "held-out", exposure=EXPOSURES[1]).scores()
    plain = scored_view(frame, rendered, "held-out").scores()
    assert scores["psnr_db"] > 60.0 > plain["psnr_db"] and scores["psnr_neutral_db"] == plain["psnr_neutral_db"]
    assert plain["psnr_neutral_db"] == plain["psnr_db"]
