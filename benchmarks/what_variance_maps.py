"""Maps of a few keyframes at true poses, and the ways to learn σ² that `what_variance_is_good_for.py` compares."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from four_frames import TrueSequence, fit, located
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.field import COLUMNS, GaussianField
from sigmasplat.errors import SourceError
from sigmasplat.fit.losses import NLL_EPS
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources import open_source
from sigmasplat.plugins.sources.room.render import RoomScene, build_scene
from sigmasplat.plugins.sources.synthetic import SyntheticRoom
from sigmasplat.render.cpu import CpuView
from sigmasplat.uncertainty.calibration import splat_residuals

Matrix = NDArray[np.float64]
ROOM, MIRRORS = "room", "room with mirrors"
ROOM_FRAMES = 200
LARGE_M, MIRROR = 0.9, 0.4
"""Surfaces that extend this far in two directions (floor, walls, ceiling) are mirrors in `MirrorRoom`: they reflect
this share of the light."""
KEYFRAMES, WINDOWS = 5, 5
SPACING, FAST_SPACING, FAST = 4, 2, ("hololens",)
"""Frames from one keyframe to the next; recordings with fast motion."""
OPAQUE = 0.9
"""Pixels with less alpha are not scored and not used for poses."""
COLORS, SIGMAS = COLUMNS["colors"], COLUMNS["log_variances"]
REFIT_RATE = 0.15
"""Learning rate of log σ² in a refit, falling to 0: 60 times the paper's, so that 60 steps reach as far as 1800."""
RANKED = 10_000
"""Pixels of a window, drawn at random, of which ranks are compared."""
TRAINED = {"none": (0.0, 0.0), "code": (1e-4, 0.0), "text": (1e-4, 1e-4)}
"""Weights of the NLL of colour and of depth with which a map is trained. The text's loss is the sum of both NLLs."""


class MirrorRoom(SyntheticRoom):
    """The synthetic room with a polished floor and glass on its walls and ceiling; their depth is exact."""

    def _scene(self, i: int) -> RoomScene:
        room = build_scene(self._rooms, self._seed, *self._built)
        shapes = [
            replace(shape, material=replace(shape.material, mirror=MIRROR))
            if (np.asarray(shape.half) > LARGE_M).sum() >= 2 else shape
            for shape in room.shapes
        ]  # fmt: skip
        return RoomScene(shapes, room.lights)


def opened(name: str, seed: int, config: Config) -> Source:
    """Return a room of this seed, with the noise of a depth camera, or a recording."""
    made = {ROOM: SyntheticRoom, MIRRORS: MirrorRoom}.get(name)
    if made is None:
        return open_source(located(name), config.input)
    return made(ROOM_FRAMES, config.input.width, 3 * config.input.width // 4, seed, True, exposure_change=False)


def map_config(width: int, seed: int, iterations: int) -> Config:
    """Return the settings of a map: those of `varsplat-fast`, poses fixed."""
    settings: dict[str, str] = {
        "seed": seed, "input.width": width, "seeding.first_uniform": width * width // 3,
        "seeding.first_gradient": width * width // 5, "mapping.iterations": iterations,
        "mapping.first_iterations": 3 * iterations, "mapping.lr_pose_translation": 0.0, "mapping.lr_pose_rotation": 0.0,
    }  # fmt: skip
    return override(preset_of("varsplat-fast"), {name: str(value) for name, value in settings.items()})


@dataclass(frozen=True, eq=False)
class Window:
    """Frames of a source: keyframes, which a map is fitted to, and live frames between them; `seed` chooses them."""

    source: str
    seed: int
    config: Config
    steps: int

    @cached_property
    def sequence(self) -> TrueSequence:
        """Return the frames at working size with their true poses."""
        return TrueSequence(opened(self.source, self.seed, self.config), self.config)

    @cached_property
    def keyframes(self) -> list[int]:
        """Return the indices of the keyframes; the windows of all seeds are spread evenly over a source."""
        spacing = FAST_SPACING if self.source in FAST else SPACING
        span = (KEYFRAMES - 1) * spacing
        start = self.seed % WINDOWS * (len(self.sequence) - 1 - span) // (WINDOWS - 1)
        return [self._first_with_truth(start, span) + k * spacing for k in range(KEYFRAMES)]

    def _first_with_truth(self, start: int, span: int) -> int:
        """Return the first frame from `start` on where it and the next `span` frames have a true pose; `start`
        if there is none."""
        for first in range(start, len(self.sequence) - span):
            try:
                for i in range(first, first + span + 1):
                    self.sequence.pose(i)
            except SourceError:
                continue
            return first
        return start

    @property
    def between(self) -> list[int]:
        """Return the frames in the middle between keyframes: they are held out of the map."""
        return [(a + b) // 2 for a, b in zip(self.keyframes, self.keyframes[1:], strict=False)]

    def pose(self, i: int) -> Matrix:
        """Return the true T_camera_map of a frame; the map has the axes of the first keyframe."""
        return se3.inverse(self.sequence.pose(i)) @ self.sequence.pose(self.keyframes[0])

    def view(self, variance: bool = True) -> CpuView:
        """Make planes for the camera."""
        return CpuView(self.sequence.frame(self.keyframes[0]).camera, self.config.render, variance)

    def target(self, i: int) -> Target:
        """Return the images of a frame."""
        rows, columns = self.view(False).alpha.shape
        return Target.of(self.sequence.frame(i), (rows, columns))

    def fitted(self, trained: str) -> GaussianField:
        """Fit a map to the keyframes at their true poses."""
        color, depth = TRAINED[trained]
        mapping = replace(self.config.mapping, weight_nll_color=color, weight_nll_depth=depth)
        return fit(self.sequence, replace(self.config, mapping=mapping), self.keyframes, self.steps)["fitted"]


def closed_form(window: Window, field: GaussianField, columns: Sequence[int] = (0, 0, 0)) -> Tensor:
    """Return log σ² [N, 3] of the residuals at the keyframes, shared among splats by their weights; columns: 0 = of
    colour, 1 = of depth, m²."""
    frames = [Keyframe(i, window.target(i), se3.inverse(window.pose(i)), fixed=True) for i in window.keyframes]
    found = splat_residuals(field, frames, window.config.render, window.config.backend)[:, list(columns)]
    return found.clamp(min=NLL_EPS).log()


def refitted(window: Window, field: GaussianField, loss: str, steps: int) -> Tensor:
    """Return log σ² [N, 3] after steps of Adam on a negative log likelihood with all else fixed.

    code: ½ r²/V + ½ log V of colour; text: (r² + r_depth²)/2V + log V; alone: as code, with Σ w σ² instead of V.
    """
    view, params = window.view(), field.params.clone()
    if loss == "alone":
        params[:, COLORS] = 0.0
    known = [_residuals(window, view, field.params, i) for i in window.keyframes]
    s, random = params[:, SIGMAS].clone(), np.random.default_rng(window.seed)
    m, v = torch.zeros_like(s), torch.zeros_like(s)
    for step in range(1, steps + 1):
        T, color2, depth2, valid = known[int(random.integers(len(known)))]
        params[:, SIGMAS] = s
        view.forward(params, T)
        V = (view.sums[4:7] - view.sums[:3].square()).clamp(min=0.0) + NLL_EPS
        square, logs = (color2 + depth2, 1.0) if loss == "text" else (color2, 0.5)
        on_V = valid * (logs / V - 0.5 * square / V.square()) / valid.sum()
        g = s.exp() * view.gather(on_V)
        m.lerp_(g, 0.1)
        v.lerp_(g.square(), 0.001)
        move = (m / (1 - 0.9**step)) / ((v / (1 - 0.999**step)).sqrt() + 1e-15)
        s -= REFIT_RATE * (1.0 - (step - 1) / steps) * move
    return s


def _residuals(window: Window, view: CpuView, params: Tensor, i: int) -> tuple[Matrix, Tensor, Tensor, Tensor]:
    """Return a keyframe's pose, squared residuals of colour and depth, and which pixels have a reading, all planes."""
    target, T = window.target(i), window.pose(i)
    view.forward(params, T)
    read = (target.depth > 0).float()
    return T, (view.sums[:3] - target.color).square(), (read * (view.sums[3] - target.depth)).square()[None], read


def with_sigma(params: Tensor, log_variances: Tensor, alone: bool = False) -> Tensor:
    """Return rows with these log σ²; alone: black, so that their V is Σ w σ²."""
    rows = params.clone()
    rows[:, SIGMAS] = log_variances
    if alone:
        rows[:, COLORS] = 0.0
    return rows


REFITS = {"code": "code", "text": "text", "σ² alone": "alone"}


def sigmas_of(window: Window, field: GaussianField, steps: int) -> dict[str, Tensor]:
    """Return log σ² [N, 3] by the way it is learned, on one map."""
    return {name: refitted(window, field, loss, steps) for name, loss in REFITS.items()} | {
        "closed form": closed_form(window, field)
    }


def measure_sigma(window: Window, field: GaussianField, sigmas: Mapping[str, Tensor]) -> dict[str, dict[str, float]]:
    """Score the V of every way to learn σ² at the held-out frames; the tables say what each score means.

    The last seed also scores maps that are trained with the NLL of code and text from the start.
    """
    constant = np.log(
        np.mean([float(_residuals(window, window.view(), field.params, i)[1].mean()) for i in window.keyframes])
    )
    ways = {name: (field, s, name in ("σ² alone", "closed form")) for name, s in sigmas.items()}
    ways |= {
        "closed form + Var(E)": (field, sigmas["closed form"], False),
        "Var(E), no σ²": (field, torch.full((len(field), 3), -40.0), False),
        "constant": (field, torch.full((len(field), 3), float(constant)), True),
    }
    for trained in ("code", "text") if window.seed == WINDOWS - 1 else ():
        made = window.fitted(trained)
        ways[f"{trained}, as trained"] = (made, made.params[:, SIGMAS], False)
    return {name: scores(window, *way) for name, way in ways.items()}


def scores(window: Window, field: GaussianField, log_variances: Tensor, alone: bool = False) -> dict[str, float]:
    """Score V (alone: only Σ w σ²) against the squared error of colour at opaque pixels of the held-out frames."""
    planes = [planes_at(window, field, log_variances, i) for i in window.between]
    r2, sigma, scatter = (np.concatenate([p[k] for p in planes], 1).astype(np.float64) for k in range(3))
    V = (sigma if alone else sigma + scatter) + NLL_EPS
    return {
        "share": float(sigma.mean() / V.mean()),
        "ratio": float(V.mean() / r2.mean()),
        "spearman": rank(V.mean(0), r2.mean(0)),
        "spearman_scatter": rank(scatter.mean(0), r2.mean(0)),
        "nll": float(0.5 * (r2 / V + np.log(V)).mean()),
        "nll_scaled": float(0.5 * (1.0 + np.log(V).mean() + np.log((r2 / V).mean()))),
    }


def rank(V: Matrix, r2: Matrix) -> float:
    """Return the Spearman correlation; 0 if one of both is constant."""
    drawn = np.random.default_rng(0).permutation(len(V))[:RANKED]
    return 0.0 if np.ptp(V) <= 1e-9 * V.max() else float(spearmanr(V[drawn], r2[drawn]).statistic)


def planes_at(window: Window, field: GaussianField, log_variances: Tensor, i: int) -> list[NDArray[np.float32]]:
    """Return r², Σ w σ² and Var(E) [3, P] of the opaque pixels of a frame at its true pose."""
    view, T, target = window.view(), window.pose(i), window.target(i)
    view.forward(with_sigma(field.params, log_variances, alone=True), T)
    sigma = view.sums[4:7].clone()
    view.forward(with_sigma(field.params, log_variances), T)
    h, w = target.camera.height, target.camera.width
    inside = torch.zeros_like(view.alpha, dtype=torch.bool)
    inside[:h, :w] = view.alpha[:h, :w] > OPAQUE
    scatter = (view.sums[4:7] - view.sums[:3].square() - sigma).clamp(min=0.0)
    r2 = (view.sums[:3] - target.color).square()
    return [plane[:, inside].numpy() for plane in (r2, sigma, scatter)]


def psnr_db(window: Window, field: GaussianField, frames: Sequence[int]) -> float:
    """Return the PSNR of a map over opaque pixels of frames."""
    s = field.params[:, SIGMAS]
    return float(-10.0 * np.log10(np.mean([planes_at(window, field, s, i)[0].mean() for i in frames])))
