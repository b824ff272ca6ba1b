"""Submaps as part of SLAM, on the beginning of a walk through the built-in room, small."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from sigmasplat.config import Config, FinalConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import SubmapStore
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.render import render
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam
from small_room import frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SMALL = {"input.width": "160", "mapping.first_iterations": "40", "mapping.iterations": "10", "final.iterations": "20"}
ONE = {"submaps.distance_m": "0", "submaps.uncertainty_m": "0"}
CUT = ONE | {"submaps.frames": "10", "loops.min_interval": "1", "loops.min_similarity": "0.3"}
FRAMES = 26


@cache
def there_and_back() -> list[Frame]:
    """Walk thirteen frames ahead and the same way back, so that the end sees the beginning's place."""
    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    return [replace(frame_at(i), index=n, timestamp_s=n / 30.0) for n, i in enumerate(order)]


def settings(**changes: str) -> Config:
    names = {name.replace("__", "."): value for name, value in changes.items()}
    return override(preset(default_preset()), SMALL | CUT | names)


def noisy() -> list[Frame]:
    """Return the same walk with the noise of a camera: in exact images V vanishes, and its likelihood blurs the map."""
    random = np.random.default_rng(0)
    walked = there_and_back()
    noise = (random.normal(0.0, 0.008, frame.color.shape) for frame in walked)
    return [replace(f, color=(f.color + n).clip(0, 1).astype(np.float32)) for f, n in zip(walked, noise, strict=True)]


def followed(
    config: Config, store: SubmapStore | None = None, finish: bool = True, frames: Sequence[Frame] | None = None
) -> Slam:
    slam = Slam(config, store)
    for frame in there_and_back() if frames is None else frames:
        slam.step(frame)
    if finish:
        slam.finish()
    return slam


@pytest.fixture(scope="module")
def run() -> Slam:
    return followed(settings())


def error_m(slam: Slam) -> float:
    truth = walk().truth()
    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    known = type(truth)(np.arange(FRAMES) / 30.0, truth.T_world_camera[order])
    return ate(slam.trajectory(), known).rmse_m


def contents(slam: Slam) -> dict[str, bytes]:
    saved = {name: tensor.numpy().tobytes() for name, tensor in slam.checkpoint().items()}
    return saved | {"map": slam.field.params.numpy().tobytes()}


def test_the_map_is_cut_and_the_path_goes_on(run: Slam) -> None:
    submaps = [step.submap for step in run.steps]
    assert sorted(set(submaps)) == [0, 1, 2]
    assert submaps == sorted(submaps)
    assert not any(step.lost for step in run.steps)
    assert error_m(run) < 0.01


def test_each_submap_starts_with_the_last_keyframe_of_the_previous_one_at_its_origin(run: Slam) -> None:
    pieces = [run.store.load(i) for i in range(len(run.store))]
    assert len(pieces) == 3
    for before, after in pairwise(pieces):
        assert np.array_equal(after.T_submap_camera[0], np.eye(4))
        assert before.frames[-1] == after.frames[0]
        shared = [run.atlas.anchors[p.index] @ p.T_submap_camera[k] for p, k in ((before, -1), (after, 0))]
        assert np.allclose(shared[0], shared[1], atol=5e-3)


def test_a_submap_shows_what_its_keyframes_saw(run: Slam) -> None:
    picture, frame = run.store.picture(1, 0), there_and_back()[run.store.load(1).frames[0]]
    assert np.abs(picture.unit_color - frame.prepared(160, 0.1, 8.0).color).max() < 0.5 / 255 + 1e-6


def test_coming_back_closes_a_true_loop(run: Slam) -> None:
    accepted = [loop for loop in run.loops if loop.accepted]
    assert accepted
    for loop in accepted:
        there, here = (walk().truth().T_world_camera[_seen(run, s)] for s in (loop.database, loop.query))
        off = se3.inverse(se3.inverse(here) @ there) @ loop.T_query_database
        assert np.linalg.norm(off[:3, 3]) < 0.02
        assert loop.record()["T_query_database"][3] == [0.0, 0.0, 0.0, 1.0]


def _seen(run: Slam, submap: int) -> int:
    """Return which frame of the walk was the submap's first keyframe."""
    first = run.store.load(submap).frames[0]
    return min(first, FRAMES - 1 - first)


def test_a_correction_moves_anchors_and_nothing_else(run: Slam) -> None:
    steps, before = run.trajectory().T_world_camera.copy(), [p.T_keyframe_camera.copy() for p in run.atlas.places]
    files = [run.store.load(i).field.params.clone() for i in range(3)]
    correction, anchor = se3.exp(np.full(6, 0.1)), run.atlas.anchors[1]
    run.atlas.anchors[1] = correction @ anchor
    moved = run.trajectory().T_world_camera
    run.atlas.anchors[1] = anchor
    inside = np.array([place.submap == 1 for place in run.atlas.places])
    assert np.allclose(moved[inside], correction @ steps[inside])
    assert np.array_equal(moved[~inside], steps[~inside])
    assert all(np.array_equal(a, p.T_keyframe_camera) for a, p in zip(before, run.atlas.places, strict=True))
    assert all(torch.equal(a, run.store.load(i).field.params) for i, a in enumerate(files))


def test_the_same_bytes_again_and_from_disk(run: Slam, tmp_path: Path) -> None:
    assert contents(followed(settings(), DiskStore(tmp_path))) == contents(run)
    assert len(list(tmp_path.iterdir())) == 3


def test_the_path_without_loops_is_that_of_a_run_without_loops() -> None:
    """Without the graph of keyframes, which aligns also to keyframes that a loop has moved."""
    one, other = (followed(settings(loops__close=close, final__move_poses="false")) for close in ("true", "false"))
    assert any(loop.accepted for loop in one.loops)
    assert np.array_equal(one.atlas.T_world_camera(loops=False), other.trajectory().T_world_camera)
    assert not np.array_equal(one.trajectory().T_world_camera, other.trajectory().T_world_camera)


def test_no_rule_means_one_submap_and_an_empty_store() -> None:
    slam = followed(override(settings(final__iterations="0"), {"submaps.frames": "0"}))
    assert len(slam.store) == 0
    assert {step.submap for step in slam.steps} == {0}
    assert slam.field is slam.mapper.field
    assert not slam.loops


def test_one_submap_is_refined_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FinalConfig, "prune_weight_px", 0.0)
    slam = followed(override(settings(final__iterations="5"), {"submaps.frames": "0"}))
    assert len(slam.store) == 1
    assert not slam.loops
    assert len(slam.field) > 0.9 * len(slam.mapper.field)
    assert slam.field is not slam.mapper.field


@pytest.mark.slow
def test_the_final_map_shows_frames_as_well_as_its_parts_and_the_path_stays_true(run: Slam) -> None:
    """Frames that are not keyframes are compared with the final map and with their submap."""
    walked = noisy()
    slam = followed(settings(final__iterations="300"), frames=walked)
    scores, atlas = list[tuple[float, float]](), slam.atlas
    poses = zip(slam.trajectory().T_world_camera, atlas.T_submap_camera, slam.steps, strict=True)
    for frame, (T_world_camera, T_submap_camera, step) in zip(walked, poses, strict=True):
        if step.is_keyframe:
            continue
        seen, pair = frame.prepared(160, 0.1, 8.0), []
        part = slam.store.load(atlas.places[step.index].submap).field
        for field, T in ((slam.field, T_world_camera), (part, T_submap_camera)):
            image = render(field, seen.camera, se3.inverse(T), options=slam.config.render).color
            pair.append(psnr(image.clamp(0, 1).numpy(), seen.color, seen.depth_m > 0))
        scores.append((pair[0], pair[1]))
    final_db, submaps_db = np.mean(scores, 0)
    assert final_db > submaps_db
    assert slam.refinement_steps == 300 and len(slam.field) < sum(len(slam.store.load(i).field) for i in range(3))
    # The poses follow the map, but stay near the tracked ones: 0.5 mm farther off, over seeds.
    assert error_m(slam) < error_m(run) + 0.8e-3
    assert np.array_equal(slam.trajectory().T_world_camera[0], np.eye(4))


def test_a_successor_inherits_the_splats_in_view_unless_inherit_is_off() -> None:
    """Inherited splats are where they were in the world, and only those that the new submap's first view can feel."""
    slam = followed(settings(loops__close="false", submaps__frames="0"), finish=False)
    T_submap_camera, whole = slam.mapper.keyframes[-1].T_world_camera, slam.mapper.field
    assert slam.view is not None
    heir = slam.mapper.successor(slam.view, T_submap_camera).field
    assert 0 < len(heir) < len(whole)
    old = {tuple(row) for row in whole.params[:, 7:].tolist()}
    assert all(tuple(row) in old for row in heir.params[:, 7:].tolist())
    back = heir.moved(torch.from_numpy(T_submap_camera))
    apart = (back.means[:50, None] - whole.means).norm(dim=2)
    assert float(apart.min(1).values.max()) < 1e-5
    slam.mapper.config = settings(submaps__inherit="false")
    assert len(slam.mapper.successor(slam.view, T_submap_camera).field) == 0


@pytest.mark.parametrize("inherit", [True, False])
def test_a_successor_that_inherits_splats_makes_the_second_half_of_the_steps(inherit: bool) -> None:
    """No step is made twice or left out at a cut; without inheritance the first submap makes all of them."""
    every = {
        "submaps__inherit": str(inherit).lower(),
        "mapping__first_iterations": "10",
        "loops__close": "false",
        "mapping__overlap_below": "0",
    }
    slam, steps = Slam(settings(**every)), list[int]()
    for frame in there_and_back()[:14]:
        step = slam.step(frame)
        steps.append(slam.mapper.field.steps)
        if step.submap and step.is_keyframe:
            assert slam.mapper.pending == 5
    assert slam.mapper.pending == 0
    cut = 10
    if inherit:  # two keyframes of the first submap with 10 steps, and half of the third
        assert steps[cut - 1 : cut + 4] == [20, 25, 27, 29, 30]
    else:  # a new map with its own 10 steps
        assert steps[cut - 1 : cut + 4] == [20, 5, 7, 9, 10]


@pytest.mark.parametrize(
    ("steps", "expected"), [("0", [(0, 1), (1, 1)]), ("2", [(0, 2), (0, 2), (1, 2), (2, 2), (2, 2)])]
)
def test_finishing_reports_progress_from_start_to_end(steps: str, expected: list[tuple[int, int]]) -> None:
    config = settings(final__iterations=steps, uncertainty__probes="0")
    slam, told, stored = Slam(config), list[tuple[int, int]](), list[int]()
    for frame in there_and_back()[:3]:
        slam.step(frame)

    def progress(done: int, total: int) -> None:
        told.append((done, total))
        stored.append(len(slam.store))

    slam.finish(progress)
    assert told == expected
    assert stored[0] < stored[-1], "the first before the last submap is finished and its loops are tried"


def test_an_unfinished_run_shows_all_submaps_side_by_side() -> None:
    slam = followed(settings(loops__close="false"), finish=False)
    assert len(slam.store) == 2
    splats = sum(len(slam.store.load(i).field) for i in range(2)) + len(slam.mapper.field)
    assert len(slam.field) == splats
    assert not slam.loops


def test_the_uncertainty_rule_fires_sooner_where_images_say_less() -> None:
    """A blurred, coarse depth makes alignment less certain: the same limit is passed after fewer frames."""
    limit = {"submaps__frames": "0", "loops__close": "false", "submaps__uncertainty_m": "0.0048"}
    sure = followed(settings(**limit), finish=False)
    slam = Slam(settings(**limit))
    random = np.random.default_rng(0)
    for frame in there_and_back():
        noise = random.normal(0.0, 0.01, frame.depth_m.shape) * frame.depth_m
        gray = np.full_like(frame.color, 0.5) + 0.1 * (frame.color - 0.5)
        slam.step(Frame(frame.index, frame.timestamp_s, gray, (frame.depth_m + noise).astype(np.float32), frame.camera))
    assert len(slam.atlas.anchors) > len(sure.atlas.anchors)
    assert not any(step.lost for step in slam.steps)


def test_netvlad_without_weights_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"loops\.weights"):
        Slam(settings(loops__descriptor="netvlad"))
