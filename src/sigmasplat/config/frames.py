"""Settings of what is done frame by frame: render, seeding, mapping, tracking."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class RenderConfig:
    """How splats become pixels; the thresholds are 3DGS's."""

    alpha_min: float = 1.0 / 255.0
    """A splat adds nothing to a pixel where its alpha is below this."""
    transmittance_stop: float = 1e-4
    """A splat contributes to a pixel if at least this share of light still passes in front of it."""
    near_m: float = 0.05
    """Splats nearer to the camera than this are not drawn, metres; smaller for cameras that nearly touch things."""
    low_pass_px2: float = 0.3
    """Added to the 2D covariance's diagonal, px²."""
    covariance_pose_gradient: bool = True
    """Whether the pose gradient includes the path through the 2D covariance."""
    mean_pose_gradient: bool = True
    """… and the path through the 2D mean: off for experiments only, tracking by Adam lives on it."""
    depth_pose_gradient: bool = True
    """… and the path through the splats' depths, which the depth loss needs."""
    color_pose_gradient: bool = True
    """… and the path through colours that depend on the direction they are seen from."""


@dataclass(frozen=True)
class SeedConfig:
    """Where new splats come from (VarSplat §2, seeding)."""

    first_uniform: int = 100_000
    """So many pixels of the first keyframe become splats wherever they are; more for large images, fewer for speed."""
    first_gradient: int = 50_000
    """… and so many more, drawn where colour changes most."""
    first_edges: bool = True
    """… and every pixel on a Canny edge, and beside one."""
    later_max: int = 30_000
    """At most this many new splats per keyframe; 0 = no limit."""
    alpha_below: float = 0.6
    """Seed where the map stops less than this share of the light; higher fills holes sooner and makes more splats."""
    depth_error_factor: float = 40.0
    """Seed where the rendered surface lies behind the measured one by this multiple of the median depth error; 0 = off
    (CG-SLAM)."""
    depth_error_least_m: float = 0.0
    """… and by at least this much."""
    min_distance_m: float = 0.01
    """No seed nearer than this to an existing splat in view."""
    opacity: float = 0.5
    """Opacity that a seed begins with, 0 to 1; high ones can be tracked on sooner, low ones are moulded more freely."""
    scale_from: Literal["neighbours", "pixel"] = "neighbours"
    """neighbours: root mean squared distance to the 3 nearest (papers'); pixel: its size at that depth × spacing."""
    scale_factor: float = 1.0
    """Seeds are this many times the size that `scale_from` gives; larger closes gaps, smaller keeps edges."""
    push_back: float = 1.005
    """Seeds lie at this multiple of the reading: blending near splats first pulls depth forward (VarSplat's code)."""
    density: float = 1.0
    """Share of the pixels chosen at a later keyframe that become splats."""
    outlier_neighbours: int = 0
    """Statistical outlier removal over this many neighbours; 0 = off."""
    max_splats: int = 0
    """Budget of a submap; 0 = no limit."""


@dataclass(frozen=True)
class MappingConfig:
    """fit_field: iterations, weights, learning rates (VarSplat §2; CG-SLAM §3, 5, 7)."""

    every: int = 1
    """A keyframe is mapped every so many frames."""
    overlap_below: float = 0.0
    """… and as soon as a frame shares less than this with the newest keyframe; 0 = off."""
    iterations: int = 100
    """Steps per keyframe; the first thing to change between speed and quality."""
    first_iterations: int = 100
    """… and for the first keyframe of a map, which is made of nothing: a raw map renders too near until about 150."""
    newest_probability: float = 0.4
    """Share of a keyframe's steps that look at it itself; the others look at older ones, drawn evenly."""
    weight_l1: float = 0.8
    """On |Ĉ − C|, colours in [0, 1] (VarSplat §2)."""
    weight_ssim: float = 0.2
    """On 1 − SSIM, which asks for structure rather than brightness (VarSplat §2)."""
    weight_depth: float = 1.0
    """On |D̂ − D|, metres; less where the sensor's depth is worse than its colour (VarSplat §2)."""
    weight_isotropy: float = 1.0
    """On |s − mean(s)|, metres (VarSplat §2)."""
    weight_isotropy_ratio: float = 0.0
    """On max(s) / min(s) − 1 (CG-SLAM eq. 17)."""
    weight_alignment: float = 0.0
    """On |D̂ − median depth| (CG-SLAM eq. 16)."""
    weight_moment: float = 0.0
    """On U, the variance of splats' depths about the sensor's (CG-SLAM eq. 10)."""
    weight_nll_color: float = 1e-4
    """On the likelihood of the colour error under V: what teaches splats their σ² (VarSplat §2); 0 = none is learned
    from colour."""
    weight_nll_depth: float = 0.0
    """… and of the depth error, metres; 0 = none is learned from depth."""
    lr_means: float = 1e-4
    """Rate of positions, metres per step of Adam."""
    lr_means_first: float = 0.0
    """The first keyframe's steps begin with this one and come down to `lr_means`, evenly in log; 0 = `lr_means`."""
    lr_quats: float = 1e-3
    """Rate of rotations, per step of a unit quaternion's numbers."""
    lr_log_scales: float = 5e-3
    """Rate of sizes, per step of the logarithm: 0.005 is half a per cent."""
    lr_opacity_logits: float = 0.05
    """Rate of opacities, per step of the logit."""
    lr_colors: float = 2.5e-3
    """Rate of colours, per step of 0 to 1."""
    lr_log_variances: float = 2.5e-3
    """Rate of σ², per step of the logarithm; higher where `iterations` are few, so that σ² arrives."""
    lr_pose_translation: float = 0.0
    """Above 0, mapping moves its keyframes' poses too, so many metres per step; the first stays."""
    lr_pose_rotation: float = 0.0
    """… and turns them by so many radians per step."""
    poses: Literal["all", "newest"] = "all"
    """Whose poses it moves: of all keyframes it looks at (CG-SLAM eq. 21), or the newest alone (its code)."""
    poses_from: Literal["start", "half"] = "start"
    """Whether poses move in all of a keyframe's steps, or in the second half only (CG-SLAM)."""
    color_covariance: Literal["diagonal", "full"] = "diagonal"
    """Whether a splat's appearance variance is one number a channel (paper) or a full 3×3 covariance."""
    freeze_old_colors: bool = False
    """Whether colours of splats that are older than the keyframe stay as they are."""
    prune_opacity: float = 0.5
    """Splats no more opaque than this after a keyframe's steps go; lower keeps haze, higher tears holes."""
    keyframe_history: int = 0
    """Older keyframes drawn from the latest so many; 0 = all."""
    window: int = 0
    """Look at so many keyframes only: the newest, the one before, and those that share most with the newest (CG-SLAM's
    sliding bundle adjustment); 0 = all, drawn at random (VarSplat)."""
    covisibility: Literal["splats", "frustum", "descriptor"] = "splats"
    """What the window's keyframes share: splats that dominate pixels of both, readings of the one that the other sees
    too, or looks, by the descriptor of `loops`."""
    frames_per_step: int = 1
    """A step descends the mean loss of so many keyframes of the window; 0 = of all of them (CG-SLAM)."""


@dataclass(frozen=True)
class TrackingConfig:
    """fit_pose: method, iterations, masks, weights (VarSplat §3; CG-SLAM §6)."""

    method: Literal["adam", "align"] = "adam"
    """adam: gradient descent through the renderer, as in the papers; align: one render, then Gauss–Newton on it."""
    iterations: int = 200
    """Adam's steps per frame at most; more for fast or shaky motion, fewer for speed."""
    align_iterations: int = 15
    """Gauss–Newton steps at most, per pyramid level."""
    align_to: Literal["keyframe", "map"] = "keyframe"
    """keyframe: the newest keyframe's own image, weighed by V; map: the map rendered at the predicted pose."""
    align_depth_by: Literal["V", "U"] = "V"
    """Weigh depth residuals by V like gray ones, or by the map's depth variance U (CG-SLAM eq. 10) in the same form."""
    align_stop: float = 1e-4
    """A level is done when a step is below this (metres and radians)."""
    align_weight_color: float = 0.5
    """Share of the gray residual against depth when aligning."""
    parametrisation: Literal["quaternion", "axis-angle"] = "quaternion"
    """What Adam moves: a quaternion and a translation after the first guess (VarSplat's code), or the camera-to-world
    rotation's axis-angle and the camera's position (CG-SLAM)."""
    first_iterations: int = 0
    """Adam's iterations for the second frame, which has no motion to go by; 0 = as for the others."""
    first_lr_rotation: float = 0.0
    """… and its rate of rotation; 0 = as for the others."""
    lr_rotation: float = 2e-3
    """Rate of rotation, radians per step; a quaternion's numbers turn twice as far. Higher for fast motion."""
    lr_translation: float = 1e-2
    """Rate of translation, metres per step."""
    weight_color: float = 0.6
    """λ_c; depth has 1 − λ_c."""
    uncertainty: bool = True
    """Weight pixels by exp(−(log V − median)/τ); off = LoopSplat."""
    tau: float = 50.0
    """τ of that weight, in units of log V: at 50 a V ten times the median costs 5 % of it. Smaller trusts V more."""
    weight_max: float = 3.0
    """… and its bounds: no pixel counts more than this many times, or less than 1 / this."""
    alpha_power: float = 3.0
    """Pixels count by rendered alpha to this power: higher leaves out where the map is thin."""
    alpha_above: float = 0.0
    """Only pixels whose rendered alpha exceeds this; 0 = off."""
    outlier_factor: float = 50.0
    """Only pixels whose depth error is below this multiple of its median; 0 = off."""
    outlier_factor_color: float = 0.0
    """Colour counts only where its error, summed over the channels, is below this multiple of its median; 0 = off."""
    average: Literal["image", "kept"] = "image"
    """Whether colour's and depth's errors are averaged over all pixels, or over those each of them keeps (CG-SLAM)."""
    motion_model: bool = True
    """Whether the first guess goes on at the last frame's speed; off = from the last pose, for jerky cameras."""
    reinit_factor: float = 5.0
    """When the first loss exceeds this multiple of its running median: odometry start and twice the iterations."""
    exposure: bool = False
    """Whether a factor and an offset of the colour are fitted with the pose, for cameras that change their exposure."""
    lr_exposure: float = 0.01
    """… and their rate, per step, of the factor's logarithm and of colours 0 to 1."""
    lost_agreement: float = 0.6
    """Lost when less than this share of the surfaces that map and sensor have in common agrees in depth."""
    lost_share: float = 0.2
    """Lost when the map agrees with less than this share of what the sensor sees (agreement × overlap)."""
    update_stop: float = 0.0
    """Adam stops when a step is below this (metres and radians); 0 = run every iteration."""
    plateau_stop: float = 0.0
    """Either method stops (aligning: a level) when a step changes the loss by less than this share of it; 0 = off."""
    cuda_graphs: bool = True
    """On a CUDA device, launch many iterations of descent each as one CUDA graph; off = kernel by kernel."""
