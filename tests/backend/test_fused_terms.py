"""A loss term that a device's kernels do not have is computed by autograd beside them; it is never dropped."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from paper_settings import MappingConfig
from sigmasplat import config as settings
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.fit import losses
from sigmasplat.fit.backends import step_for
from sigmasplat.fit.field import fit_field, loss_weights
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.reference import ReferenceView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, params_of, view_on
from splat_fits import target_of
from splat_scenes import WIDE, scene

OWN = "darkness"


@dataclass(frozen=True)
class OwnMapping(settings.MappingConfig):
    """Mapping's settings with a weight for it, as docs/recipes.md adds one."""

    lr_colors: ClassVar[float] = 0.02
    weight_darkness: float = 0.0


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
