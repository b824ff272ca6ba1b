"""One mapping step on a view: compute the gradient of the image terms, propagate it to the splats, take Adam's step;
the same with view-dependent colours, spherical harmonics (VarSplat §7, refinement).
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sigmasplat.data.field import COLUMNS, GaussianField, Rows
from sigmasplat.data.harmonics import basis, count, view_colors
from sigmasplat.errors import ConfigError
from sigmasplat.fit import losses
from sigmasplat.fit.adam import ROWS_AT_ONCE, Rates, adam_rows, adam_step
from sigmasplat.fit.interface import Accumulator, MappingStep, Twist, Weights
from sigmasplat.fit.losses import maps_of, take
from sigmasplat.fit.target import Target
from sigmasplat.render.kernels import variance_of
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def render_for(view: View, params: Tensor, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
    """Render rows into the view's planes, with the outputs that terms with a nonzero weight need."""
    reference = target.depth_image if take(weights, "moment") else None
    view.forward(params, T_camera_world, reference, layers=take(weights, "median_depth"))


def shape_gradient(log_scales: Tensor, weights: Weights, of_all: float, of_visible: float) -> tuple[Tensor, float]:
    """Return the gradient of the weighted shape terms by the log scales [n, 3] of some splats, and the cost.

    of_all, of_visible: the number of these splats relative to all splats, over which `isotropy` is a mean, and to those
    in view, over which the other terms are.
    """
    leaf, of_scales = log_scales.clone().requires_grad_(), {n: x for n, x in weights.items() if "scales" in maps_of(n)}
    shares = {name: weight * (of_all if name == "isotropy" else of_visible) for name, weight in of_scales.items()}
    cost = losses.total(shares, {"scales": leaf.exp()})
    if not cost.requires_grad:
        return torch.zeros_like(log_scales), 0.0
    return torch.autograd.grad(cost, leaf)[0], float(cost.detach())


def planes_beside_sums(view: View, weights: Weights) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the planes that terms take beside the sums, by the names of the maps, and those of their gradients."""
    planes = {
        "moment": (view.moment, view.g_moment),
        "alpha": (view.alpha, view.g_alpha),
        "median_depth": (view.layers.median_depth, view.g_median_depth),
    }
    return {name: pair for name, pair in planes.items() if take(weights, name)}


def image_gradients(view: View, target: Target, weights: Weights) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Return the loss of the image terms, and a list of the view's gradient planes with their gradients, by autograd.

    Terms of the splats are skipped, and so are terms of the variance if the view has none.
    """
    v, (h, w) = view, target.depth_image.shape
    absent = {"scales"} if len(v.sums) >= 7 else {"scales", "variance"}
    used = {name: weight for name, weight in weights.items() if not absent & maps_of(name)}
    planes = {"sums": (v.sums, v.g_sums)} | planes_beside_sums(v, used)
    leaves = {name: values.detach().clone().requires_grad_() for name, (values, _) in planes.items()}
    sums = leaves["sums"][:, :h, :w].movedim(0, -1)
    maps: dict[str, Tensor] = {name: leaf[:h, :w] for name, leaf in leaves.items() if name != "sums"} | {
        "color": sums[..., :3],
        "depth": sums[..., 3],
        "color_target": target.image,
        "depth_target": target.depth_image,
        "valid": target.depth_image > 0,
    }
    if len(v.sums) >= 7:
        maps["variance"] = variance_of(sums)
    loss = losses.total(used, maps)
    found = torch.autograd.grad(loss, list(leaves.values()), materialize_grads=True)
    return loss.detach(), [(plane, value) for (_, plane), value in zip(planes.values(), found, strict=True)]


class GradientAccumulator:
    """Sum of the gradient of several images' mean loss with respect to the splats visible in any of them."""

    def __init__(self, view: View, field: GaussianField) -> None:
        self._view = view
        self.grad, self._rows = torch.zeros_like(field.params), torch.zeros_like(field.params)
        self.visible = torch.zeros(len(field), dtype=torch.bool, device=field.params.device)

    def add(self, field: GaussianField, share: float, grad2d: Tensor | None = None) -> Matrix:
        twist = self._view.backward(field.params, self._rows, grad2d)
        self.visible |= self._view.visible(len(field))
        self.grad += share * self._rows
        return twist

    def step(self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int) -> float:
        scales = COLUMNS["log_scales"]
        of_all = float(self.visible.sum()) / max(len(field), 1)
        on_scales, cost = shape_gradient(field.params[self.visible][:, scales], weights, of_all, 1.0)
        rows = self.grad[self.visible]
        rows[:, scales] += on_scales
        self.grad[self.visible] = rows
        self.grad[:frozen_colors, COLUMNS["colors"]] = 0.0
        adam_step(field, self.grad, rates, self.visible)
        return cost


class TorchStep:
    """One mapping step in its defining form: terms of `losses`, gradients by autograd, `adam_step`."""

    def __init__(self, view: View) -> None:
        self.view = view
        view.g_alpha.zero_()  # only terms of alpha write it

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        render_for(self.view, field.params, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        loss, gradients = image_gradients(self.view, target, weights)
        for plane, gradient in gradients:
            plane.copy_(gradient)
        return float(loss)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Twist, float | Tensor]:
        accumulator = self.accumulator(field)
        twist = accumulator.add(field, 1.0, grad2d)
        return twist, accumulator.step(field, rates, weights, frozen_colors)

    def accumulator(self, field: GaussianField) -> Accumulator:
        return GradientAccumulator(self.view, field)


class OwnTermsStep:
    """A device's fused step, together with the image terms that its kernels do not support, which autograd computes."""

    def __init__(self, fused: MappingStep, own: frozenset[str]) -> None:
        self._fused, self._own = fused, own
        self.view, self.forward, self.splats, self.accumulator = (
            fused.view, fused.forward, fused.splats, fused.accumulator,
        )  # fmt: skip

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        of_own = {n: w for n, w in weights.items() if n in self._own}
        for _, gradient in planes_beside_sums(self.view, of_own).values():
            gradient.zero_()  # the kernels write it for their own terms only
        fused = self._fused.images(target, {n: w for n, w in weights.items() if n not in self._own})
        own, gradients = image_gradients(self.view, target, of_own)
        for plane, gradient in gradients:
            plane.add_(gradient)
        return fused + own


COLORS, MEANS, SCALES = (COLUMNS[name] for name in ("colors", "means", "log_scales"))


class ViewDependentStep:
    """One mapping step of a field with view-dependent colours of degree 1 to 3.

    The view renders rows with the colours that this camera sees, and returns the gradient of these rows.
    """

    def __init__(self, base: MappingStep, degree: int) -> None:
        self.base, self.view, self.degree = base, base.view, degree
        self.width = 3 * count(degree)
        self.rows, self._R, self._position = torch.empty(0), torch.empty(0), torch.empty(0)

    def forward(self, field: GaussianField, T_camera_world: Matrix, target: Target, weights: Weights) -> None:
        self._R, t = (
            torch.as_tensor(part).to(field.params) for part in (T_camera_world[:3, :3], T_camera_world[:3, 3])
        )
        self._position = -(self._R * t[:, None]).sum(0)
        self.rows, harmonics = field.params.clone(), field.get_or_create("harmonics").params
        ahead = field.means @ self._R[2] + t[2] > 0
        for rows in torch.split(ahead.nonzero().squeeze(1), ROWS_AT_ONCE):
            own, k = field.params.index_select(0, rows), harmonics.index_select(0, rows)
            own[:, COLORS] = view_colors(own[:, COLORS], k, own[:, MEANS], self._position, self.degree)
            self.rows.index_copy_(0, rows, own)
        render_for(self.view, self.rows, T_camera_world, target, weights)

    def images(self, target: Target, weights: Weights) -> float | Tensor:
        return self.base.images(target, weights)

    def splats(
        self, field: GaussianField, rates: Rates, weights: Weights, frozen_colors: int, grad2d: Tensor | None = None
    ) -> tuple[Twist, float | Tensor]:
        grad, cost = torch.zeros_like(field.params), 0.0
        twist = self.view.backward(self.rows, grad, grad2d)
        whole = field.get_or_create("harmonics")
        whole.steps += 1
        # The harmonics of the degrees in use share memory with the field's.
        params, moment1, moment2 = (x[:, : self.width] for x in (whole.params, whole.moment1, whole.moment2))
        harmonics = Rows(params, moment1, moment2, whole.last_step, whole.steps)
        harmonic_rates = Rates(rates.of_attribute("harmonics").per_column[: self.width], rates.beta2)
        visible = self.view.visible(len(field)).nonzero().squeeze(1)
        for rows in torch.split(visible, ROWS_AT_ONCE):
            g, own, k = (x.index_select(0, rows) for x in (grad, field.params, harmonics.params))
            g[rows < frozen_colors, COLORS] = 0.0
            g_harmonics, g_means = self._through_colors(own, k, g[:, COLORS])
            g_scales, term = shape_gradient(
                own[:, SCALES], weights, len(rows) / max(len(field), 1), len(rows) / max(len(visible), 1)
            )
            g[:, MEANS] += g_means
            g[:, SCALES] += g_scales
            twist[:3] += (self._R @ g_means.sum(0)).cpu().numpy()  # a camera motion ρ acts like a splat motion −ρ
            cost += term
            adam_rows(field, rows, g, rates)
            adam_rows(harmonics, rows, g_harmonics, harmonic_rates)
        return twist, cost

    def accumulator(self, field: GaussianField) -> Accumulator:
        """Raise ConfigError: this step takes one image only."""
        raise ConfigError("a step on several keyframes needs colours without view dependence (mapping.adjustment)")

    def _through_colors(self, own: Tensor, harmonics: Tensor, g_shown: Tensor) -> tuple[Tensor, Tensor]:
        """Propagate the gradient of view-dependent colours [n, 3] to harmonics [n, width] and, by the direction, to
        means [n, 3]."""
        means = own[:, MEANS].clone().requires_grad_()
        values = basis(normalize(means - self._position, dim=1), self.degree)
        g_harmonics = values.detach()[:, :, None] * g_shown[:, None, :]
        g_values = (harmonics.reshape(-1, self.width // 3, 3) @ g_shown[:, :, None])[:, :, 0]
        (g_means,) = torch.autograd.grad(values, means, g_values)
        return g_harmonics.reshape(-1, self.width), g_means
