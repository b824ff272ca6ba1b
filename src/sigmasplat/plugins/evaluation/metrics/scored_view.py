"""Store one recorded image with its rendering, and score the pair."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.plugins.evaluation.metrics.image import SSIM_LEAST_PX, depth_l1, ms_ssim, psnr, similarity_factors, ssim
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips

COVERED_ALPHA = 0.5
"""Above this alpha a pixel counts as covered by the map: its depth is Σwz / Σw."""


@dataclass(frozen=True, eq=False)
class PredictedErrors:
    """What a map predicts of the errors of a view, variances [H, W]: of colour (mean over channels, colour²) in two
    parts, and of the difference between rendered depth and a reading of the sensor (m²), with its epistemic part."""

    color_aleatoric: NDArray[np.float32]
    color_epistemic: NDArray[np.float32]
    reading_m2: NDArray[np.float32]
    depth_epistemic_m2: NDArray[np.float32]

    @property
    def reading_aleatoric_m2(self) -> NDArray[np.float32]:
        """Return the part of reading_m2 that more views do not reduce [H, W]."""
        return np.asarray(np.maximum(self.reading_m2 - self.depth_epistemic_m2, 0.0), np.float32)

    @property
    def color(self) -> NDArray[np.float32]:
        """Return the variance of colour [H, W]."""
        return self.color_aleatoric + self.color_epistemic


@dataclass(frozen=True, eq=False)
class ScoredView:
    """A recorded image and its rendering at the estimated pose, float32.

    recorded, rendered: [H, W, 3] in [0, 1]; recorded_depth_m [H, W] (0 = no reading); rendered_depth_m [H, W]
    (0 where alpha ≤ ½); alpha [H, W]; variance: V [H, W, 3], colour² (VarSplat §1); notes: shown below the view strip;
    predicted: the predictive variances, None if they are not known; neutral [H, W, 3]: the rendering in the exposure of
    the map, None if it is `rendered`.
    """

    index: int
    kind: str
    recorded: NDArray[np.float32]
    recorded_depth_m: NDArray[np.float32]
    rendered: NDArray[np.float32]
    rendered_depth_m: NDArray[np.float32]
    alpha: NDArray[np.float32]
    variance: NDArray[np.float32]
    notes: tuple[str, ...] = field(default=())
    predicted: PredictedErrors | None = None
    neutral: NDArray[np.float32] | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Return which pixels have a depth reading [H, W]. Scores use only these pixels, unless they say otherwise."""
        return self.recorded_depth_m > 0

    @property
    def uncertainty(self) -> NDArray[np.float32]:
        """Return V averaged over the channels [H, W], colour². Negative values (rounding) become 0."""
        return np.asarray(np.maximum(self.variance.mean(-1), 0.0), np.float32)

    @property
    def squared_errors(self) -> NDArray[np.float32]:
        """Return (Ĉ − C)² of each channel [H, W, 3], colour²."""
        return np.asarray((self.rendered - self.recorded) ** 2, np.float32)

    @property
    def squared_error(self) -> NDArray[np.float32]:
        """Return (Ĉ − C)² averaged over the channels [H, W], colour²."""
        return np.asarray(self.squared_errors.mean(-1), np.float32)

    @property
    def depth_compared(self) -> NDArray[np.bool_]:
        """Return which pixels have a depth reading and a rendered depth [H, W]."""
        return self.valid & (self.rendered_depth_m > 0)

    @property
    def depth_squared_error(self) -> NDArray[np.float32]:
        """Return the squared difference of rendered depth and reading [H, W], m²; it counts where `depth_compared`."""
        return np.asarray((self.rendered_depth_m - self.recorded_depth_m) ** 2, np.float32)

    def scores(self, lpips: Lpips | None = None) -> dict[str, float]:
        """Return the scores of the view.

        PSNR (dB), SSIM, depth L1 (m) and the share of depth readings that the map covers use the valid pixels. PSNR of
        the image (dB), MS-SSIM and LPIPS use all pixels, as published systems do; nan if they are not known. The
        neutral PSNR (dB, valid pixels) is that of the rendering in the exposure of the map.
        """
        valid = self.valid
        covered = float((self.rendered_depth_m > 0)[valid].mean()) if valid.any() else float("nan")
        factors = similarity_factors(self.rendered, self.recorded) if min(valid.shape) >= SSIM_LEAST_PX else None
        return {
            "psnr_db": psnr(self.rendered, self.recorded, valid),
            "psnr_neutral_db": psnr(self.rendered if self.neutral is None else self.neutral, self.recorded, valid),
            "ssim": ssim(self.rendered, self.recorded, valid, factors),
            "depth_l1_m": depth_l1(self.rendered_depth_m, self.recorded_depth_m),
            "depth_coverage": covered,
            "psnr_image_db": psnr(self.rendered, self.recorded),
            "ms_ssim": ms_ssim(self.rendered, self.recorded, factors),
            "lpips": lpips.distance(self.rendered, self.recorded) if lpips else float("nan"),
        }
