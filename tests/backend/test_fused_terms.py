"""A loss term that a device's kernels do not have is computed by autograd beside them; it is never dropped."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from paper_settings import MappingConfig
from sigmasplat import config as settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.errors import ConfigError
from sigmasplat.fit import losses
from sigmasplat.fit.backends import step_for
from sigmasplat.fit.field import fit_field, loss_weights
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, params_of, view_on
from splat_fits import target_of
from splat_scenes import WIDE, assert_same_vector, scene

OWN = "darkness"


@dataclass(frozen=True)
class OwnMapping(settings.MappingConfig):
    """Mapping's settings with a weight for it, as docs/recipes.md adds one."""

    lr_colors: ClassVar[float] = 0.02
    weight_darkness: float = 0.0
    weight_of_map: float = 0.0


def darkness(color: Tensor, valid: Tensor) -> Tensor:
    """A term of one's own, which only its name tells from the others."""
    return losses.mean_over(1.0 - color, valid)


def loss_on(view: View, weights: dict[str, float]) -> tuple[float, Tensor]:
    """Return the loss of a scene on a view, by the step that fits choose, and its gradient by colour."""
    s = scene("random", 60)
    params = params_of(s)
    field, target = GaussianField(params), target_of(WIDE, (view.alpha.shape[0], view.alpha.shape[1]))
    step = step_for(view, weights, 0)
    step.forward(field, s.T_camera_world.double().numpy(), target, weights)
    loss = float(step.images(target, weights))
    return loss, step.view.g_sums[:3, : WIDE.height, : WIDE.width].clone()


def test_a_term_that_the_kernels_do_not_have_counts_all_the_same(kernels: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(losses.TERMS, OWN, darkness)
    plain = loss_weights(MappingConfig(weight_nll_color=1e-2))
    weights = plain | {OWN: 0.3}
    got, gradient = loss_on(view_on(kernels, WIDE), weights)
    want, want_gradient = loss_on(ReferenceView(WIDE, OPTIONS), weights)
    assert got == pytest.approx(want, rel=1e-4)
    torch.testing.assert_close(gradient, want_gradient, rtol=1e-3, atol=1e-6)
    assert want > loss_on(ReferenceView(WIDE, OPTIONS), plain)[0] + 0.05, "the term counts"


def test_a_fit_descends_a_term_of_ones_own(kernels: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(losses.TERMS, OWN, darkness)
    s, brightness = scene("random", 60), {}
    config = OwnMapping(weight_l1=0.0, weight_darkness=3.0)
    for degree in (0, 1):
        field, view = GaussianField(params_of(s)), view_on(kernels, WIDE)
        target = target_of(WIDE, (view.alpha.shape[0], view.alpha.shape[1]))
        keyframe = Keyframe(0, target, se3.inverse(s.T_camera_world.double().numpy()))
        fit = fit_field(field, view, [[keyframe]] * 20, config, degree=degree)
        brightness[degree] = float(field.colors.mean())
        assert fit.losses[-1] < fit.losses[0] and brightness[degree] > float(params_of(s)[:, 11:14].mean()) + 0.02


OF_MAPS: dict[str, Callable[..., Tensor]] = {
    "color": lambda color, color_target, valid: losses.mean_over((color - color_target).square(), valid),
    "depth": lambda depth, depth_target, valid: losses.mean_over((depth - depth_target).square(), valid),
    "alpha": lambda alpha, valid: losses.mean_over(1.0 - alpha, valid),
    "variance": lambda variance, valid: losses.mean_over(variance, valid),
    "moment": lambda moment, valid: losses.mean_over((1.0 + moment).log(), valid),
    "median_depth": lambda median_depth, valid: losses.mean_over((1.0 + median_depth).log(), valid),
    "scales": lambda scales: scales.square().sum(1).mean(),
}  # fmt: skip
"""A term of one's own for each map, beside which no built-in term takes that map."""


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("name", OF_MAPS)
def test_a_term_of_ones_own_can_take_every_map(
    kernels: str, name: str, degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three steps on the device's kernels and by the definition change the splats alike."""
    monkeypatch.setitem(losses.TERMS, "of_map", OF_MAPS[name])
    s, found = scene("random", 60), []
    for weight, view in (
        (1.0, view_on(kernels, WIDE)),
        (1.0, ReferenceView(WIDE, OPTIONS)),
        (0.0, ReferenceView(WIDE, OPTIONS)),
    ):
        config = OwnMapping(weight_l1=0.1, weight_mean_depth=0.0, weight_of_map=weight)
        field, target = GaussianField(params_of(s)), target_of(WIDE, (view.alpha.shape[0], view.alpha.shape[1]))
        keyframe = Keyframe(0, target, se3.inverse(s.T_camera_world.double().numpy()))
        fit = fit_field(field, view, [[keyframe]] * 3, config, degree=degree)
        found.append((fit.losses, field.moment1))
    (got, moments), (want, want_moments), (without, _) = found
    assert got == pytest.approx(want, rel=2e-3) and abs(want[0] - without[0]) > 1e-3
    assert_same_vector(moments, want_moments, 2e-2, name)


def test_a_term_of_unknown_maps_is_refused_by_name() -> None:
    def bumpy(normal: Tensor, valid: Tensor) -> Tensor:
        return losses.mean_over(normal, valid)

    def mixed(scales: Tensor, depth: Tensor) -> Tensor:
        return scales.mean() * depth.mean()

    for function, message in (
        (bumpy, "loss term 'bumpy' takes normal; known: alpha, "),
        (mixed, "takes scales; .* or scales alone"),
    ):
        with pytest.raises(ConfigError, match=message):
            losses.term(function)
        assert function.__name__ not in losses.TERMS
