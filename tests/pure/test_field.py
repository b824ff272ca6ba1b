"""The field: one row per splat, edited once for parameters and both moments; carried rigidly with what it shows."""

import numpy as np
import pytest
import torch
from torch import Tensor

from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import COLUMNS, WIDTH, GaussianField, left_factor, quaternion_of, transformed
from sigmasplat.errors import SigmaSplatError
from sigmasplat.render import render

CAMERA = Camera(33, 21, 30.0, 31.0, 15.2, 10.7)


def numbered(n: int, first: int) -> GaussianField:
    """Make rows in which every value says whose it is: row + a tenth per tensor."""
    rows = torch.arange(first, first + n).float()[:, None].repeat(1, WIDTH)
    return GaussianField(rows.clone(), rows + 0.1, rows + 0.2)


def assert_rows(field: GaussianField, rows: list[int]) -> None:
    want = torch.tensor(rows).float()[:, None].repeat(1, WIDTH)
    for tensor, off in ((field.params, 0.0), (field.moment1, 0.1), (field.moment2, 0.2)):
        torch.testing.assert_close(tensor, want + off)
    assert len(field) == len(rows)


def test_columns_cover_every_parameter_once() -> None:
    taken = [k for columns in COLUMNS.values() for k in range(columns.start, columns.stop)]
    assert taken == list(range(WIDTH))


def test_append_and_keep_edit_all_three_together() -> None:
    field = numbered(4, 0)
    field.append(numbered(3, 10))
    assert_rows(field, [0, 1, 2, 3, 10, 11, 12])
    field.keep(torch.tensor([True, False, False, True, False, True, True]))
    assert_rows(field, [0, 3, 11, 12])
    field.keep(torch.tensor([3, 1]))
    assert_rows(field, [12, 3])
    field.keep(torch.zeros(2, dtype=torch.bool))
    assert_rows(field, [])
    field.append(numbered(2, 5))
    assert_rows(field, [5, 6])


def test_new_rows_start_without_moments() -> None:
    field = numbered(2, 0)
    field.append(GaussianField(torch.full((1, WIDTH), 7.0)))
    assert torch.count_nonzero(field.moment1[2]) == 0 and torch.count_nonzero(field.moment2[2]) == 0
    assert len(GaussianField.empty()) == 0


def test_another_shape_is_refused() -> None:
    for shape in [(3, 16), (17,), (2, 3, 17)]:
        with pytest.raises(SigmaSplatError, match=r"params \[N, 17\]"):
            GaussianField(torch.zeros(shape))


def random_field(n: int = 40, seed: int = 0) -> GaussianField:
    rng = np.random.default_rng(seed)
    means = torch.as_tensor(rng.uniform([-1, -0.7, 1.0], [1, 0.7, 3.0], (n, 3))).float()
    scales, colors, quats = (torch.as_tensor(x).float() for x in (
        rng.uniform(0.02, 0.3, (n, 3)), rng.uniform(0, 1, (n, 3)), rng.normal(size=(n, 4))
    ))  # fmt: skip
    opacities, s = torch.as_tensor(rng.uniform(0.2, 0.9, n)).float(), torch.as_tensor(rng.uniform(-7, -2, (n, 3)))
    return GaussianField.from_values(means, scales, colors, quats=quats, opacities=opacities, log_variances=s.float())


def test_values_come_back_activated() -> None:
    rng = np.random.default_rng(1)
    means, scales, colors = (torch.as_tensor(rng.uniform(0.1, 0.9, (5, 3))).float() for _ in range(3))
    field = GaussianField.from_values(means, scales, colors, opacities=0.3)
    torch.testing.assert_close(field.scales, scales)
    torch.testing.assert_close(field.opacities, torch.full((5,), 0.3))
    torch.testing.assert_close(field.variances, torch.full((5, 3), float(np.exp(-7.0))))
    assert torch.equal(field.means, means) and torch.equal(field.colors, colors)
    assert torch.equal(field.quats, torch.tensor([[1.0, 0, 0, 0]]).repeat(5, 1))
    balls = GaussianField.from_values(means, scales[:, 0], colors)
    torch.testing.assert_close(balls.scales, scales[:, :1].repeat(1, 3))


def picture(field: GaussianField, T_camera_world: Tensor) -> list[Tensor]:
    r = render(field, CAMERA, T_camera_world, options=RenderConfig(), backend="reference")
    return [r.color, r.depth, r.alpha, r.variance]


def test_moved_carries_what_is_seen() -> None:
    """A camera that moves along sees the same: the render at T·M⁻¹ of the field moved by M."""
    for seed in range(4):
        field = random_field(seed=seed)
        M = se3.exp(np.random.default_rng(seed).normal(size=6))
        moved = field.moved(torch.as_tensor(M))
        before, after = picture(field, torch.eye(4)), picture(moved, torch.as_tensor(se3.inverse(M)).float())
        for a, b in zip(before, after, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=2e-4)
            assert float((a - b).norm()) < 1e-4 * float(a.norm())
        stayed = picture(moved, torch.eye(4))
        assert float((before[0] - stayed[0]).norm()) > 0.1 * float(before[0].norm())


def test_moved_leaves_looks_shapes_and_the_original_alone() -> None:
    field, M = random_field(), se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.8, 0.2]))
    field.steps = 12
    original, moved = field.params.clone(), field.moved(torch.as_tensor(M))
    assert torch.equal(field.params, original)
    assert torch.equal(moved.params[:, 7:], original[:, 7:]) and moved.steps == 12
    back = moved.moved(torch.as_tensor(se3.inverse(M)))
    torch.testing.assert_close(back.means, field.means, rtol=0, atol=1e-6)
    torch.testing.assert_close(moved.quats.norm(dim=1), field.quats.norm(dim=1))
    moved.moment1 += 1.0
    assert torch.count_nonzero(field.moment1) == 0


def test_quaternion_products_compose_rotations() -> None:
    rng = np.random.default_rng(0)
    A, b = se3.exp(rng.normal(size=6))[:3, :3], rng.normal(size=(6, 4))
    product = transformed(torch.as_tensor(b), left_factor(quaternion_of(torch.as_tensor(A)))).numpy()
    np.testing.assert_allclose(se3.rotation_from_quaternion(product), A @ se3.rotation_from_quaternion(b), atol=1e-12)


def test_moved_turns_adams_moments_with_the_splats() -> None:
    """A step taken before moving lands where the step taken after moving does, where all rates of a block are alike."""
    field, M = random_field(), torch.as_tensor(se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.8, 0.2])))
    field.moment1 = torch.randn(field.params.shape, generator=torch.Generator().manual_seed(1))
    stepped = GaussianField(field.params - 0.01 * field.moment1)
    moved = field.moved(M)
    again = GaussianField(moved.params - 0.01 * moved.moment1)
    torch.testing.assert_close(stepped.moved(M).params[:, :7], again.params[:, :7], rtol=0, atol=1e-5)
    field.moment2 = torch.ones_like(field.params)
    torch.testing.assert_close(field.moved(M).moment2, field.moment2)


def test_ids_name_splats_for_life() -> None:
    field = GaussianField(torch.randn(4, 17))
    field.keep(torch.tensor([True, False, True, True]))
    assert field.ids.tolist() == [0, 2, 3]
    field.append(GaussianField(torch.randn(2, 17)))
    assert field.ids.tolist() == [0, 2, 3, 4, 5]
    field.keep(torch.tensor([0, 4]))
    field.append(GaussianField(torch.randn(1, 17)))
    assert field.ids.tolist() == [0, 5, 6], "an id is never given twice"
    assert field.moved(torch.eye(4)).ids.tolist() == [0, 5, 6]


@pytest.mark.parametrize("count", [0, 1, 2, 5, 8, 11])
def test_fields_side_by_side_are_those_appended_one_after_another(count: int) -> None:
    generator = torch.Generator().manual_seed(count)
    fields = [GaussianField(torch.randn(n % 4, WIDTH, generator=generator)) for n in range(count)]
    for n, field in enumerate(fields):
        if n % 3 == 0:
            field.get_or_create("harmonics").params[:] = float(n)
    one_by_one = GaussianField.empty()
    for field in fields:
        one_by_one.append(field)
    joined = GaussianField.side_by_side(fields)
    assert torch.equal(joined.params, one_by_one.params) and torch.equal(joined.ids, one_by_one.ids)
    assert joined.next_id == one_by_one.next_id and joined.attributes.keys() == one_by_one.attributes.keys()
    for name, attribute in one_by_one.attributes.items():
        assert torch.equal(joined.attributes[name].params, attribute.params)


@pytest.mark.parametrize("chosen", [[0, 3], [0, 1, 2, 3, 4], []])
def test_a_part_of_a_field_keeps_ids_and_optimiser_and_shares_nothing(chosen: list[int]) -> None:
    whole = GaussianField(torch.arange(5.0)[:, None] + torch.zeros(5, WIDTH), steps=7)
    whole.keep(torch.tensor([4, 3, 2, 1, 0]))
    whole.moment1 += 1.0
    whole.get_or_create("harmonics").params += whole.params[:, :1]
    before = whole.copy_to(whole.params.device)
    rows = torch.zeros(5, dtype=torch.bool)
    rows[chosen] = True
    part = whole.part(rows)
    assert part.ids.tolist() == [4 - row for row in chosen] and (part.steps, part.next_id) == (7, 5)
    for name in ("params", "moment1", "moment2", "last_step"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[rows])
    assert torch.equal(part.attributes["harmonics"].params, whole.attributes["harmonics"].params[rows])
    part.params += 1.0
    part.attributes["harmonics"].params += 1.0
    assert torch.equal(whole.params, before.params) and len(whole) == 5
    assert torch.equal(whole.attributes["harmonics"].params, before.attributes["harmonics"].params)
