"""A loss term that a device's kernels do not have runs in torch there; it is never dropped."""

from typing import Any

import pytest
import torch
from torch import Tensor

from sigmasplat.config import MappingConfig
from sigmasplat.fit import fused_terms, losses
from sigmasplat.fit.backends import step_for
from sigmasplat.fit.field import loss_weights
from sigmasplat.fit.fused_terms import FusedTerm
from sigmasplat.model.field import GaussianField
from sigmasplat.render.cuda.view import CudaView
from sigmasplat.render.reference.view import ReferenceView
from sigmasplat.render.view import View
from splat_fields import OPTIONS, params_of
from splat_fits import target_of
from splat_scenes import WIDE, scene

OWN = "darkness"


def darkness(color: Tensor, valid: Tensor) -> Tensor:
    """A term of one's own, which only its name tells from the others."""
    return losses.mean_over(1.0 - color, valid)


def loss_on(view: View, weights: dict[str, float]) -> tuple[float, Tensor]:
    """Return the loss of a scene on a view, by the step that fits choose, and its gradient by colour."""
    s = scene("random", 60)
    params = params_of(s)
    field, target = GaussianField(params), target_of(WIDE, (view.alpha.shape[0], view.alpha.shape[1]))
    step = step_for(field, view, weights, 0)
    step.forward(field, s.T_camera_world.double().numpy(), target, weights)
    return float(step.images(target, weights)), view.g_sums[:3].clone()


@pytest.mark.parametrize("fused_on", [(), ("cpu",)], ids=["on no device", "on the CPU alone"])
def test_a_term_that_cuda_does_not_fuse_counts_all_the_same(
    on_the_cpu: Any, monkeypatch: pytest.MonkeyPatch, fused_on: tuple[str, ...]
) -> None:
    monkeypatch.setitem(losses.TERMS, OWN, darkness)
    if fused_on:
        monkeypatch.setitem(fused_terms.PIXEL_TERMS, OWN, FusedTerm(6, frozenset(fused_on)))
    plain = loss_weights(MappingConfig())
    weights = plain | {OWN: 0.3}
    got, gradient = loss_on(CudaView(WIDE, OPTIONS, True, torch.device("cpu")), weights)
    want, want_gradient = loss_on(ReferenceView(WIDE, OPTIONS), weights)
    assert got == pytest.approx(want, rel=1e-4)
    torch.testing.assert_close(gradient, want_gradient, rtol=1e-3, atol=1e-6)
    assert want > loss_on(ReferenceView(WIDE, OPTIONS), plain)[0] + 0.05, "the term counts"
