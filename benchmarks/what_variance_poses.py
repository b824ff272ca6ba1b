"""Find a camera again in a known map, its colour weighted in different ways: for `what_variance_is_good_for.py`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from localise import Search, disturbed
from scipy.ndimage import gaussian_filter
from torch import Tensor
from what_variance_maps import OPAQUE, Matrix, Window, closed_form, with_sigma

from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.losses import NLL_EPS
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import outlier_mask, uncertainty_weights

WHOLE, MISSING, WRONG, COLOR = "as recorded", "no depth on half", "depth 5 % off on half", "colour only"
CONDITIONS = {WHOLE: 0.6, MISSING: 0.6, WRONG: 0.6, COLOR: 1.0}
"""Conditions of the live frame, with λ_c, the weight of colour: 0.6 is VarSplat's for TUM and ScanNet."""
DEPTH_OFF = 1.05
OUTLIER, ALPHA_POWER = 50.0, 3.0
START = Search(off_m=0.01, off_deg=0.5, steps=0, weight_color=0.0)
SMOOTH_PX = 3.0
"""The oracle's squared residual is averaged over this radius (σ of a Gaussian): a variance, not one error."""
MOST_STEPS, REWEIGHTED = 5, 4
"""Gauss–Newton steps, and solutions of reweighted least squares in each. V is rendered anew in each step."""
DIFFERENCE, NEAR, CONVERGED, FARTHEST = 1e-3, 2e-3, 2e-4, 0.02
"""Of twists about a point at the median depth, m and rad: for derivatives, the distance at which they are used, the
last step, the longest step."""
LEAST_COLOR, LEAST_M = 0.002, 0.001
"""Smaller errors count as quadratic: half a step of 8-bit colour, a millimetre."""


class Weigh(NamedTuple):
    """A way to weigh pixels: a variance, τ, and the largest weight; likelihood: by 1/σ of colour and of depth instead,
    without λ_c, τ and limits; constant: one σ for the whole image."""

    by: str
    tau: float = 1.0
    most: float = 3.0
    likelihood: bool = False
    constant: bool = False


NONE, REAL, ORACLE, EACH_PIXEL = "none", "σ²", "oracle", "oracle of each pixel"
ONE_SIGMA, REAL_LIKELIHOOD, ORACLE_LIKELIHOOD = "one σ each", "σ of colour and depth", "oracle of colour and depth"
WEIGHTS = {
    NONE: Weigh(""),
    "V, τ 10": Weigh("V", 10.0),
    "V, τ 3": Weigh("V", 3.0),
    "V, τ 1": Weigh("V"),
    REAL: Weigh("σ²"),
    ORACLE: Weigh("oracle"),
    EACH_PIXEL: Weigh("pixel", most=30.0),
    ONE_SIGMA: Weigh("σ²", likelihood=True, constant=True),
    REAL_LIKELIHOOD: Weigh("σ²", likelihood=True),
    ORACLE_LIKELIHOOD: Weigh("oracle", likelihood=True),
}
"""V: VarSplat's text, at the live pose. σ²: Σ w σ² of the closed form. oracle: the true squared residual, smoothed."""


@dataclass(frozen=True, eq=False)
class Live:
    """A live frame: images, true pose, and the oracle's squared residuals [4, H, W] of colour and depth, each pixel and
    smoothed."""

    target: Target
    T_true: Matrix
    pixel: Tensor
    oracle: Tensor


class Pose:
    """The search for the pose of live frames in one map."""

    def __init__(self, window: Window, field: GaussianField, sigmas: Mapping[str, Tensor]) -> None:
        self.window, self.params = window, field.params
        self.view, self.view_V = window.view(False), window.view()
        self.derivatives = list[tuple[Matrix, Tensor]]()
        camera = self.view.camera
        v, u = np.indices((camera.height, camera.width))
        chessboard = torch.from_numpy(np.flatnonzero(np.broadcast_to((u + v) % 2 == 0, (4, *u.shape))))
        self.used = chessboard
        self.least = torch.tensor([LEAST_COLOR] * 3 + [LEAST_M]).repeat_interleave(u.size)[chessboard]
        self.rows = {
            "V": with_sigma(field.params, sigmas["text"]),
            "σ²": with_sigma(field.params, closed_form(window, field, (0, 1, 1)), alone=True),
        }

    def live(self, i: int, condition: str, left: bool) -> Live:
        """Return frame i with its depth changed as a condition says, on one half; the oracle sees the change."""
        whole, T = self.window.target(i), self.window.pose(i)
        self.derivatives.clear()
        depth_m = whole.depth_image.numpy().copy()
        half = np.s_[:, : depth_m.shape[1] // 2] if left else np.s_[:, depth_m.shape[1] // 2 :]
        depth_m[half] *= {MISSING: 0.0, WRONG: DEPTH_OFF}.get(condition, 1.0)
        target = whole.with_depth(depth_m)
        off, _ = self._off(Live(target, T, torch.empty(0), torch.empty(0)), T)
        off[3] *= target.depth_image > 0
        pixel = off.square()
        smooth = torch.from_numpy(np.stack([gaussian_filter(plane.numpy(), SMOOTH_PX) for plane in pixel]))
        return Live(target, T, pixel, smooth)

    def found(self, live: Live, T: Matrix, weight_color: float, weigh: Weigh) -> Matrix:
        """Return the T_camera_map that minimises the tracking loss of VarSplat §3, from a guess, by Gauss–Newton.

        The render is linearised by differences, and the sum of absolute errors minimised by reweighted least squares:
        this finds the minimum itself, where Adam with its fixed rates would scatter about it. Every second pixel is
        used, as on a chessboard; colour where the map is opaque, also without a depth reading.
        """
        middle = np.eye(4)
        middle[2, 3] = float(live.target.depth_image[live.target.depth_image > 0].median())
        for _ in range(MOST_STEPS):
            twist = self._step(live, T, weight_color, self._weights(live, T, weight_color, weigh), middle)
            twist *= min(1.0, FARTHEST / float(np.abs(twist).max()))
            T = middle @ se3.exp(twist) @ se3.inverse(middle) @ T
            if np.abs(twist).max() < CONVERGED:
                break
        return se3.orthonormalise(T)

    def _weights(self, live: Live, T: Matrix, weight_color: float, weigh: Weigh) -> Tensor:
        """Return weights [2, 3, H, W] of colour, and of depth (three equal planes).

        VarSplat's are divided by their mean, so that colour counts as much against depth as without weights.
        """
        h, w = live.target.depth_image.shape
        if not weigh.by:
            return torch.ones(2, 3, h, w)
        mask = self._off(live, T)[1] > OPAQUE
        if weigh.by in self.rows:
            self.view_V.forward(self.rows[weigh.by], T)
            planes = (self.view_V.sums[4:7] - self.view_V.sums[:3].square()).clamp(min=0.0)[:, :h, :w]
        else:
            planes = {"oracle": live.oracle, "pixel": live.pixel}[weigh.by]
        if weigh.by == "σ²":  # the planes are those of colour, of depth, and of depth again
            planes = torch.cat([planes[:1].expand(3, -1, -1), planes[1:2]])
        if weigh.constant:
            planes = (planes[:, mask] + NLL_EPS).log().mean(1).exp()[:, None, None].expand_as(planes)
        if weigh.likelihood:
            on_color, on_depth = (planes[:3] + LEAST_COLOR**2).rsqrt(), (planes[3:] + LEAST_M**2).rsqrt()
            share = max(1.0 - weight_color, LEAST_COLOR)  # cancels the weights of `_step`
            return torch.stack([3.0 / weight_color * on_color, on_depth.expand(3, -1, -1) / share])
        return torch.stack([weighed(planes[:3], mask, weigh), torch.ones(3, h, w)])

    def _step(self, live: Live, T: Matrix, weight_color: float, weights: Tensor, middle: Matrix) -> Matrix:
        """Return the twist [6] of the camera about a point `middle` on its axis that minimises the linearised loss."""
        r, alpha = self._off(live, T)
        J = self._derivative(live, T, middle, r)
        opaque, read = alpha > OPAQUE, live.target.depth_image > 0
        share = opaque * alpha**ALPHA_POWER
        on_color = weight_color / 3.0 * share * weights[0]
        on_depth = (1.0 - weight_color) * share * outlier_mask(r[3], opaque & read, OUTLIER) * weights[1, :1]
        weight, flat = (x.reshape(-1)[self.used] for x in (torch.cat([on_color, on_depth]), r))
        twist = torch.zeros(6)
        for _ in range(REWEIGHTED):
            weighted = J * (weight / ((flat + twist @ J).abs() + self.least))
            H = (weighted @ J.T).double()
            twist = -torch.linalg.solve(
                H + 1e-9 * H.diagonal().mean() * torch.eye(6), (weighted @ flat).double()
            ).float()
        return twist.double().numpy()

    def _derivative(self, live: Live, T: Matrix, middle: Matrix, r: Tensor) -> Tensor:
        """Return the derivative [6, n] of the used residuals by the twist, at T or at a pose very near."""
        back = se3.inverse(middle)
        for T_known, J in self.derivatives:
            if np.abs(se3.log(back @ T @ se3.inverse(T_known) @ middle)).max() < NEAR:
                return J
        moved = (middle @ se3.exp(DIFFERENCE * unit) @ back @ T for unit in np.eye(6))
        J = torch.stack([(self._off(live, T_moved)[0] - r).reshape(-1)[self.used] / DIFFERENCE for T_moved in moved])
        self.derivatives.append((T, J))
        return J

    def _off(self, live: Live, T: Matrix) -> tuple[Tensor, Tensor]:
        """Return the residuals [4, H, W] of colour and depth at a pose, and alpha."""
        h, w = live.target.depth_image.shape
        self.view.forward(self.params, T)
        there = torch.cat([live.target.color[:, :h, :w], live.target.depth_image[None]])
        return self.view.sums[:, :h, :w] - there, self.view.alpha[:h, :w].clone()


def weighed(planes: Tensor, mask: Tensor, weigh: Weigh) -> Tensor:
    """Return VarSplat's weights [3, H, W] of variances [3, H, W], divided by their mean over the mask."""
    w = uncertainty_weights(planes.movedim(0, -1), mask, weigh.tau, weigh.most).movedim(-1, 0)
    return w / w[:, mask].mean()


def measure_poses(
    window: Window, field: GaussianField, sigmas: Mapping[str, Tensor], conditions: Mapping[str, float] = CONDITIONS
) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the errors of the live frames by condition and weights: "mm" of position, "mdeg" of rotation.

    The pose is found without weights from a disturbed one, and refined from there with each weight.
    """
    pose, random = Pose(window, field, sigmas), np.random.default_rng(window.seed)
    frames = window.between[1:-1]
    starts = {i: disturbed(window.pose(i), START, random) for i in frames}
    found = dict[str, dict[str, dict[str, list[float]]]]()
    for condition, weight_color in conditions.items():
        found[condition] = {name: {"mm": [], "mdeg": []} for name in WEIGHTS}
        for i in frames:
            live = pose.live(i, condition, left=(i + window.seed) % 2 == 0)
            plain, true = pose.found(live, starts[i], weight_color, WEIGHTS[NONE]), se3.inverse(live.T_true)
            for name, weigh in WEIGHTS.items():
                T = se3.inverse(pose.found(live, plain, weight_color, weigh))
                turned = se3.rotation_angle(T[:3, :3].T @ true[:3, :3])
                found[condition][name]["mm"].append(round(1e3 * float(np.linalg.norm((T - true)[:3, 3])), 4))
                found[condition][name]["mdeg"].append(round(1e3 * float(np.degrees(turned)), 3))
    return found
