"""Define a per-pixel uncertainty, score it, and weight pixels with it in tracking.

python examples/own_uncertainty.py [FRAMES]

This one is a variance of depth, m²: the scatter of the splats along a ray about the rendered surface, plus the sensor
noise, which grows with z². It uses only outputs of `render`, so no kernel and no setting has to change.
"""

import sys

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat import GaussianField, Slam, open_source, preset
from sigmasplat.config import TrackingConfig
from sigmasplat.config.text import override
from sigmasplat.data import se3
from sigmasplat.data.frame import Frame
from sigmasplat.fit.pose import fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import gray_of
from sigmasplat.fit.tracking_loss import uncertainty_weights
from sigmasplat.plugins.evaluation.metrics import uncertainty
from sigmasplat.render.render import Render, render

SETTINGS = {"input.width": "160", "mapping.first_iterations": "40", "mapping.iterations": "15"}


SENSOR_NOISE = 1.4e-3
"""Standard deviation of a structured-light sensor's depth, times z² (m): Khoshelham & Elberink 2012."""


def seen(field: GaussianField, frame: Frame, T_camera_world: NDArray[np.float64]) -> tuple[Render, Tensor, Tensor]:
    """Render twice; return the view, its surface depth [H, W] in metres and the variance of this depth [H, W], m².

    The first render gives the surface D = Σ w z / Σ w, the second U = Σ w (z − D)² about it. Both are meaningless where
    alpha is low.
    """
    with torch.no_grad():
        first = render(field, frame.camera, T_camera_world)
        depth_m = first.depth / first.alpha.clamp(min=1e-6)
        second = render(field, frame.camera, T_camera_world, depth_reference=depth_m)
    assert second.uncertainty is not None  # not None, because a reference was given
    return second, depth_m, second.uncertainty + (SENSOR_NOISE * depth_m**2) ** 2


def judged(predicted: Tensor, view: Render, depth_m: Tensor, frame: Frame) -> dict[str, float]:
    """Score a prediction [H, W] with the squared difference of surface and reading, on pixels that have both."""
    reading_m = torch.from_numpy(np.array(frame.depth_m))
    both = (reading_m > 0) & (view.alpha > 0.5)
    return uncertainty.score(predicted[both].numpy(), ((depth_m - reading_m) ** 2)[both].numpy())


def weighed(image: Pyramid, view: Render, variance: Tensor, config: TrackingConfig) -> Pyramid:
    """Weight the depth of a keyframe by a variance [H, W], as tracking does with V: w̃, and 1 where alpha is low."""
    known = view.alpha > 0.95
    w = uncertainty_weights(variance[..., None], known, config.tau, config.weight_max)[..., 0]
    return image.weighed(None, torch.where(known, w, 1.0).numpy())


def main(frames: str = "12") -> dict[str, float]:
    """Map some frames of the built-in room; score variances on a frame that was not mapped, and track it with ours."""
    config = override(preset("sigma"), SETTINGS)
    source = open_source("synthetic:frames=240,width=160,height=120,noise=1", limit=int(frames))
    slam, images = Slam(config), list(source)
    steps = [slam.step(frame) for frame in images]
    poses = [se3.inverse(T) for T in slam.trajectory().T_world_camera]
    unseen = max(step.index for step in steps if not step.is_keyframe)
    newest = max(step.index for step in steps[:unseen] if step.is_keyframe)

    view, depth_m, ours = seen(slam.field, images[unseen], poses[unseen])
    found = {}
    for name, variance in (("ours", ours), ("V, which is of colour", view.variance.mean(-1))):
        score = judged(variance, view, depth_m, images[unseen])
        print(f"{name}: Spearman with depth's squared error {score['spearman']:.2f}, AUSE {score['ause']:.2f}")
        found[name] = score["spearman"]

    view, _, ours = seen(slam.field, images[newest], poses[newest])
    keyframe, live = (Pyramid.of(gray_of(f.color), f.depth_m, f.camera) for f in (images[newest], images[unseen]))
    reference = Reference(weighed(keyframe, view, ours, config.tracking), poses[newest])
    fit = fit_pose_align(reference, live, poses[newest], config.tracking)
    apart_m = float(np.linalg.norm((fit.T_camera_world @ se3.inverse(poses[unseen]))[:3, 3]))
    print(f"tracked with depth weighted by ours: {1000 * apart_m:.2f} mm from the pose in the run")
    return {**found, "apart_m": apart_m, "agreement": fit.agreement}


if __name__ == "__main__":
    main(*sys.argv[1:])
