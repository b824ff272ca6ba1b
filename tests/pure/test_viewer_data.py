"""The viewer's data, without a browser: splats within a budget, filtering by σ, paths, rendered layers."""

import html
from dataclasses import replace

import numpy as np
import pytest
import torch

from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.plugins.outputs.drawing import colormap
from sigmasplat.plugins.viewer import snapshot as lines
from sigmasplat.plugins.viewer.layers import (
    Legend,
    ShownMap,
    browser_camera,
    covariances,
    draw_legend,
    merged,
    palette_range,
    render_layer,
    shown,
    splat_arrays,
    uncertainties,
)
from sigmasplat.plugins.viewer.panel import escaped
from sigmasplat.plugins.viewer.snapshot import CameraPath, Piece, Snapshot, thin, within_budget
from sigmasplat.plugins.viewer.snapshot_sources import final_piece
from sigmasplat.render import render
from sigmasplat.uncertainty.map_uncertainty import SHIPPED, Background, MapUncertainty, SplatStd
from sigmasplat.uncertainty.predictive import predict

OPTIONS = RenderConfig()
HOW = OPTIONS, "auto"


def field_of(count: int, seed: int = 0) -> GaussianField:
    """Return splats in front of a camera at the origin, with random shapes, colours and σ²."""
    random = np.random.default_rng(seed)
    tensor = lambda *shape, low=0.0, high=1.0: torch.tensor(random.uniform(low, high, shape), dtype=torch.float32)  # noqa: E731
    return GaussianField.from_values(
        tensor(count, 3, low=-1.0) + torch.tensor([0.0, 0.0, 3.0]),
        tensor(count, 3, low=0.01, high=0.1),
        tensor(count, 3),
        quats=tensor(count, 4, low=-1.0),
        opacities=tensor(count, low=0.2, high=0.9),
        log_variances=tensor(count, 3, low=-9.0, high=-2.0),
    )


def path_of(frames: int, every: int = 5, lost: tuple[int, ...] = (), per_submap: int = 10) -> CameraPath:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = np.arange(frames)
    marks = np.isin(np.arange(frames), lost)
    return CameraPath(poses, marks, np.arange(frames) // per_submap, tuple(range(0, frames, every)))


def test_thinning_keeps_evenly_spread_splats_and_the_covered_area() -> None:
    field = field_of(1000)
    few = thin(field, 300)
    area = lambda f: float(f.scales[:, :2].prod(1).sum())  # noqa: E731
    assert len(few) == 300 and area(few) == pytest.approx(area(field), rel=0.1)
    rows = [int((field.means == mean).all(1).nonzero()[0]) for mean in few.means]
    assert rows == sorted(set(rows)) and max(np.diff(rows)) <= 4 and rows[0] == 0 and rows[-1] >= 996
    same = thin(field, 1000)
    assert torch.equal(same.params, field.params) and same.params.data_ptr() != field.params.data_ptr()
    assert len(thin(field, 0)) == len(thin(GaussianField.empty(), 5)) == 0


def test_pieces_within_the_budget_are_unchanged_and_others_are_thinned_by_one_factor() -> None:
    pieces = [Piece(0, field_of(300)), Piece(1, field_of(100))]
    assert [p.field for p in within_budget(pieces, 400)] == [p.field for p in pieces]
    found = within_budget(pieces, 200)
    assert [len(p.field) for p in found] == [112, 37] and [p.submap for p in found] == [0, 1]


def test_covariances_equal_rotated_squared_scales() -> None:
    field = field_of(20)
    found = covariances(field.quats.numpy(), field.scales.numpy())
    for covariance, quat, scale in zip(found, field.quats.numpy(), field.scales.numpy(), strict=True):
        R = se3.rotation_from_quaternion(quat)
        np.testing.assert_allclose(covariance, R @ np.diag(scale.astype(float) ** 2) @ R.T, rtol=1e-4, atol=1e-8)


def test_the_palette_covers_nearly_all_splats_that_are_shown() -> None:
    pieces = [Piece(0, field_of(600)), Piece(1, field_of(400, seed=1))]
    values = np.concatenate([uncertainties(piece).numpy() for piece in pieces])
    assert palette_range(pieces, False) == pytest.approx(np.percentile(values, [2, 98]))
    small = [replace(piece, sure=uncertainties(piece) < 0.1) for piece in pieces]
    assert palette_range(small, False)[1] < 0.1 and palette_range(small, True) == palette_range(pieces, False)
    assert palette_range((), False) == (1.0, 2.0)


def test_splats_are_coloured_by_their_own_colour_or_by_sigma() -> None:
    field = field_of(50)
    sigma = uncertainties(Piece(None, field))
    plain = splat_arrays(Piece(None, field), None, True)
    np.testing.assert_array_equal(plain.colors, (field.colors.numpy() * 255).round().astype(np.uint8))
    tinted = splat_arrays(Piece(None, field), (0.02, 0.3), False)
    ratios = np.log(np.maximum(sigma.numpy(), 0.02) / 0.02)
    np.testing.assert_allclose(tinted.colors, colormap.apply(ratios, 0.0, np.log(0.3 / 0.02), colormap.INFERNO), atol=1)
    np.testing.assert_array_equal(tinted.centers, field.means.numpy())
    most, least = int(sigma.numpy().argmax()), int(sigma.numpy().argmin())
    assert tinted.colors[most].sum() > tinted.colors[least].sum() + 200
    half = splat_arrays(Piece(None, field, sure=sigma < sigma.median()), (0.02, 0.3), False)
    assert len(half.centers) == len(half.covariances) == len(half.colors) == int((sigma < sigma.median()).sum())


def test_merged_pieces_hold_the_visible_splats_in_the_world_frame() -> None:
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    sure = torch.arange(20) % 4 > 0
    pieces = (Piece(0, field_of(30)), Piece(1, field_of(20, seed=1), T, sure=sure))
    whole = merged(pieces, False, *HOW).field
    torch.testing.assert_close(whole.means[30:], pieces[1].field.moved(torch.from_numpy(T)).means[sure])
    assert len(whole) == 45 and len(pieces[0].field) == 30 and len(merged(pieces, True, *HOW).field) == 50


def test_merging_pieces_equals_moving_and_appending_fields() -> None:
    """One field has harmonics, which rotate with it; the other has none."""
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.5, 0.6]))
    first, second = field_of(30), field_of(20, seed=1)
    second.get_or_create("harmonics").params += torch.randn(20, 45, generator=torch.Generator().manual_seed(0))
    found = merged((Piece(0, first), Piece(1, second, T)), False, *HOW).field
    expected = first.moved(torch.eye(4))
    expected.append(second.moved(torch.from_numpy(T)))
    torch.testing.assert_close(found.params, expected.params)
    torch.testing.assert_close(found.attributes["harmonics"].params, expected.attributes["harmonics"].params)
    few = thin(second, 10)
    assert torch.equal(few.attributes["harmonics"].params, second.attributes["harmonics"].params[::2])


def test_the_timeline_shows_the_submaps_started_by_then_and_the_final_map_completely() -> None:
    pieces = tuple(Piece(i, field_of(3, seed=i)) for i in range(3))
    final = Piece(None, field_of(9))
    snapshot = Snapshot("run", path_of(30), final, pieces)
    assert snapshot.visible_pieces(0) == (final,)
    growing = Snapshot("run", path_of(30), None, pieces)
    assert [growing.visible_pieces(row) for row in (9, 10, 29)] == [pieces[:1], pieces[:2], pieces]
    assert Snapshot("run", pieces=pieces).visible_pieces(0) == pieces


def test_the_path_is_drawn_up_to_a_frame_in_submap_colours_with_lost_frames_in_red() -> None:
    path = path_of(30, lost=(5, 6))
    drawn = lines.path_segments(path, 12)
    np.testing.assert_array_equal(drawn.points[:, 0, 0], np.arange(12))
    np.testing.assert_array_equal(drawn.points[:, 1, 0], np.arange(1, 13))
    first, second = lines.SUBMAP_COLOURS
    expected = [lines.LOST_COLOUR if i in (5, 6) else first if i < 10 else second for i in range(13)]
    np.testing.assert_array_equal(drawn.colors[:, 0], expected[:-1])
    np.testing.assert_array_equal(drawn.colors[:, 1], expected[1:])
    assert len(lines.path_segments(path_of(0), 0).points) == 0 == len(lines.path_segments(path_of(1), 0).points)


def test_frames_that_are_not_connected_to_the_world_are_not_drawn() -> None:
    whole = path_of(30, lost=(5, 14))
    path = replace(whole, outside=(np.arange(30) >= 12) & (np.arange(30) < 20))
    drawn = lines.path_segments(path, 29)
    np.testing.assert_array_equal(drawn.points[:, 0, 0], [*range(11), *range(20, 29)])
    assert lines.keyframes_to_show(path, 29) == (0, 5, 10, 20, 25)


def test_long_paths_and_many_keyframes_are_reduced_without_large_changes_between_frames() -> None:
    drawn = lines.path_segments(path_of(10_000), 9_999, most=500)
    assert len(drawn.points) == 500 and drawn.points[-1, 1, 0] == 9_999
    np.testing.assert_array_equal(drawn.points[1:, 0], drawn.points[:-1, 1])
    path, before = path_of(3000, every=3), set[int]()
    for row in range(0, 3000, 30):
        shown = set(lines.keyframes_to_show(path, row, most=20))
        assert len(shown) <= 20 and max(shown) == row and min(shown) == 0
        newest_before = max(before, default=0)
        assert shown >= before - {newest_before} or len(shown) <= len(before)
        before = shown
    assert lines.keyframes_to_show(path_of(20), 12) == (0, 5, 10)


def test_a_browsers_camera_has_its_vertical_field_of_view() -> None:
    camera = browser_camera(np.radians(60.0), 1.5, 200)
    assert (camera.width, camera.height) == (300, 200)
    assert np.degrees(2 * np.arctan(100 / camera.fy)) == pytest.approx(60.0) and camera.fx == camera.fy
    assert (camera.cx, camera.cy) == (149.5, 99.5)


def test_layers_show_the_maps_of_the_renderer() -> None:
    field, camera, T = field_of(400), Camera(40, 30, 30.0, 30.0, 19.5, 14.5), np.eye(4)
    T[2, 3] = -0.5
    seen = render(field, camera, se3.inverse(T))
    shown = {n: render_layer(ShownMap(field, None, *HOW), camera, T, n) for n in ("colour", "depth", "V", "U")}
    np.testing.assert_array_equal(shown["colour"].pixels, (seen.color.clamp(0, 1) * 255).round().numpy())
    assert shown["colour"].legend is None
    covered = (seen.alpha > 0.5).numpy()
    for name in ("depth", "V", "U"):
        uncovered = (shown[name].pixels == colormap.NO_READING).all(-1)
        np.testing.assert_array_equal(uncovered, ~covered)
    root = seen.variance.mean(2).clamp(min=0).sqrt().numpy()
    legend = shown["V"].legend
    assert legend is not None and legend.high == pytest.approx(np.percentile(root[covered], 99), rel=1e-5)
    depth = shown["depth"].legend
    assert depth is not None and 2.0 < depth.low < depth.high < 4.5 and depth.unit == " m"
    for unknown in ("splats", "color error", "normals"):
        with pytest.raises(ValueError, match=f"no layer '{unknown}' is rendered"):
            render_layer(ShownMap(field, None, *HOW), camera, T, unknown)


def test_u_is_the_spread_of_depth_about_the_rendered_depth() -> None:
    """Two parallel sheets at depths 1 and 2: w₁ = a, w₂ = (1 − a) a."""
    a, z = 0.7, torch.tensor([1.0, 2.0])
    means = torch.stack([torch.zeros(2), torch.zeros(2), z], 1)
    scales = torch.tensor([[5.0, 5.0, 1e-4]] * 2)
    field = GaussianField.from_values(means, scales, torch.zeros(2, 3), opacities=a)
    shown = ShownMap(field, None, *HOW)
    made = render_layer(shown, Camera(8, 8, 100.0, 100.0, 3.5, 3.5), np.eye(4), "U")
    w1, w2 = a, (1 - a) * a
    about = (w1 * 1 + w2 * 2) / (w1 + w2)
    expected = np.sqrt((w1 * (1 - about) ** 2 + w2 * (2 - about) ** 2) / (w1 + w2))
    assert made.legend is not None and made.legend.high == pytest.approx(expected, rel=1e-3)


def uncertain(count: int, seed: int = 0) -> Piece:
    """Return a final map with known errors, each splat of another one."""
    random = torch.Generator().manual_seed(seed)
    background = Background((0.2, 0.5, 0.8), 0.1, 1.0)
    std = SplatStd(*torch.rand(2, count, generator=random))
    known = MapUncertainty(0.01 * torch.rand(count, 3, generator=random), background, SHIPPED, 4, std)
    return final_piece(field_of(count, seed), known, np.eye(4)[None])


def test_splats_that_are_not_sure_are_hidden_unless_they_are_asked_for() -> None:
    piece = uncertain(200)
    sure = piece.sure
    assert sure is not None and 0 < int(sure.sum()) < 200 and torch.equal(shown(piece, False), sure)
    drawn = splat_arrays(piece, None, False)
    np.testing.assert_array_equal(drawn.centers, piece.field.means[sure].numpy())
    field, known, *_ = merged([piece], False, *HOW)
    assert known is not None and len(known.splats) == len(field) == len(drawn.centers)
    assert len(splat_arrays(piece, None, True).centers) == 200 and shown(replace(piece, sure=None), False).all()
    assert merged([piece, piece], False, *HOW).known is None


def test_thinned_splats_keep_their_own_errors() -> None:
    piece = uncertain(100)
    few = piece.thinned(30)
    assert few.uncertainty is not None and piece.uncertainty is not None
    assert few.sure is not None and piece.sure is not None and len(few.sure) == 30
    for mean, row in zip(few.field.means, few.uncertainty.splats, strict=True):
        (same,) = (piece.field.means == mean).all(1).nonzero()[0]
        assert torch.equal(piece.uncertainty.splats[same], row)


def test_layers_of_predicted_errors_show_the_prediction() -> None:
    piece, camera, T = uncertain(400), Camera(40, 30, 30.0, 30.0, 19.5, 14.5), np.eye(4)
    known = piece.uncertainty
    assert known is not None
    found = predict(piece.field, known, camera, T, OPTIONS)
    covered = (render(piece.field, camera, T).alpha > 0.5).numpy()
    for layer, std, where, unit in (
        ("depth error", found.depth_std_m, covered, " m"),
        ("color error", found.color.sqrt(), np.ones_like(covered), ""),
    ):
        whole = render_layer(ShownMap(piece.field, known, *HOW), camera, T, layer)
        assert whole.legend is not None and whole.legend.unit == unit
        assert whole.legend.high == pytest.approx(np.percentile(std.numpy()[where], 99), rel=1e-4)
        np.testing.assert_array_equal((whole.pixels == colormap.NO_READING).all(-1), ~where)


def test_a_legend_shows_the_palette_from_end_to_end() -> None:
    drawn = draw_legend(Legend(colormap.INFERNO, 0.0, 0.25, " m"))
    np.testing.assert_array_equal(drawn[0, [0, -1]], colormap.INFERNO[[0, -1]])
    assert len(np.unique(drawn[20:].reshape(-1, 3), axis=0)) > 2


def test_names_from_files_are_shown_and_not_run() -> None:
    shown = escaped("<b>{alert(1)}</b> **küche**_1.2")
    assert not set("<>{}*_`[]") & set(shown)
    assert html.unescape(shown) == "<b>{alert(1)}</b> **küche**_1.2"
