"""Settings of the work per frame: rendering, seeding, mapping, tracking."""

from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Literal

from sigmasplat.config.ranges import Above0, AtLeastOne, Count, NotNegative, Section, Share

FIRST_FRAMES = 15
"""The steps of the first keyframe that are divided over later frames are made in about this many of them."""


@dataclass(frozen=True)
class RenderConfig(Section, name="render"):
    """Rendering of splats; the thresholds are those of 3DGS. Raises ConfigError on invalid values."""

    alpha_min: Share = 1.0 / 255.0
    """A splat is ignored at pixels where its alpha is below this."""
    transmittance_stop: ClassVar[float] = 1e-4
    """A splat contributes to a pixel only if at least this share of light passes the splats in front of it."""
    near_m: Above0 = 0.05
    """Splats closer to the camera than this are not drawn, in metres. Use a smaller value for cameras very close to
    surfaces."""
    low_pass_px2: NotNegative = 0.3
    """Added to the diagonal of the 2D covariance, in px²."""
    depth: Literal["center", "ray"] = "ray"
    """Depth of a splat at a pixel: center = that of its centre (papers); ray = where the ray meets it most densely, so
    that a flat splat can show a slanted surface (RaDe-GS). On CUDA it is center, with a warning."""
    scene_scale: Above0 = 1.0
    """Size of the scene relative to a room. Fixed limits in metres, such as the gates of alignment, are multiplied by
    it. `run` sets it for stereo recordings, together with all settings that are lengths (`config.scale.scaled`)."""
    depth_noise_per_m: Above0 = 0.003
    """Standard deviation of depth readings z is assumed to be this times z², per metre. 0.003 is a structured-light
    sensor (Khoshelham & Elberink 2012). `run` sets σ_d/(f·b) for stereo recordings."""
    covariance_pose_gradient: bool = True
    """Whether the pose gradient includes the path through the 2D covariance."""


@dataclass(frozen=True)
class SeedConfig(Section, name="seeding"):
    """Creation of new splats (VarSplat §2, seeding)."""

    first_uniform: Count = 40_000  # half of 320×240: more splats add cost but no accuracy
    """Number of pixels of the first keyframe, drawn uniformly, that become splats. Use more for large images, fewer for
    speed."""
    first_gradient: Count = 15_000
    """Number of additional pixels of the first keyframe, drawn in proportion to the image gradient, that become
    splats."""
    first_edges: bool = False  # sampling by gradient finds the same pixels
    """Whether all pixels on and beside Canny edges of the first keyframe become splats too."""
    later_max: Count = 0
    """Maximum number of new splats per later keyframe; 0 = no limit."""
    depth_error_factor: NotNegative = 40.0
    """Pixels are seeded where the rendered surface is behind the measured one by this multiple of the median depth
    error; 0 = off (CG-SLAM). They are seeded too where the rendered alpha of the map is below `alpha_below`."""
    depth_error_least_m: NotNegative = 0.1  # 40 × a median of 2 mm alone would treat sensor noise as a new surface
    """Minimum distance, in metres, between rendered and measured surface for seeding by `depth_error_factor`."""
    min_distance_m: NotNegative = 0.01
    """No seed is placed closer than this to an existing splat in view."""
    # searching the map for neighbours costs more than fitting a keyframe
    scale_from: Literal["neighbours", "pixel"] = "pixel"
    """Initial size of seeds: neighbours = root mean squared distance to the 3 nearest splats (papers); pixel = size of
    a pixel at that depth × spacing of the seeds, for fewer and more opaque seeds (`density`, `opacity`)."""
    scale_factor: Above0 = 0.65  # with the slower change of sizes, larger seeds blur submaps
    """Factor on the size from `scale_from`. A larger one closes gaps, a smaller one keeps edges."""
    thickness: Above0 = 0.1  # the depth of a disc seen at an angle is right, and the path a little better
    """Size of a seed along the surface's normal, as a share of its size along the surface; 1 = a sphere (papers). Below
    1 seeds are discs on the surface that the depth image shows, and wider where they are seen at an angle."""
    outlier_neighbours: Count = 0
    """Number of neighbours for statistical outlier removal; 0 = off."""
    outlier_first: bool = True
    """Whether outliers are also removed from the seeds of an empty map; off = VarSplat's code."""
    max_splats: Count = 250_000
    """Maximum number of splats in a submap; 0 = no limit."""

    @property
    def opacity(self) -> float:
        """Initial opacity of seeds, 0 to 1. With a higher value the map can be used for tracking sooner."""
        return 0.8 if self.scale_from == "pixel" else 0.5

    @property
    def density(self) -> float:
        """Share of the chosen pixels of a later keyframe that become splats; more of them only take more time."""
        return 0.35 if self.scale_from == "pixel" else 1.0

    @property
    def alpha_below(self) -> float:
        """Pixels are seeded where the rendered alpha of the map is below this: with CG-SLAM's rule it is ½."""
        return 0.6 if self.depth_error_factor else 0.5

    @property
    def push_back(self) -> float:
        """Factor on the depth of seeds: blending with closer splats makes rendered depth small (VarSplat's code)."""
        return 1.005 if self.depth_error_factor else 1.0


@dataclass(frozen=True)
class MappingConfig(Section, name="mapping"):
    """Fit of the map to keyframes: iterations, loss weights, learning rates (VarSplat §2; CG-SLAM §3, 5, 7)."""

    every: AtLeastOne = 5  # mapping every frame would take five times as long
    """A frame becomes a keyframe this many frames after the last keyframe."""
    overlap_below: NotNegative = 0.7  # more keyframes when the camera moves fast
    """A frame also becomes a keyframe if its overlap with the newest keyframe is below this; 0 = off."""
    iterations: Count = 8  # the final map is as good as with 15; the submaps have up to 1 dB less
    """Optimisation steps per keyframe: the first setting to change to trade speed for quality."""
    first_iterations: Count = 80  # the rendered depth has no bias from here on; without D̂/A it takes 150
    """Optimisation steps for the first keyframe of a map. Until about 150 steps, a new map renders surfaces too close,
    with `weight_mean_depth` until about 75."""
    divided: bool = True
    """Whether the steps of a keyframe are spread over frames, so that no frame takes much longer than others. The first
    half runs at the keyframe, the second half during the frames before the next keyframe. If mapping moves poses
    (`lr_pose_*`), all steps run at the keyframe, because the next frames are tracked from these poses. The first
    keyframe of a map runs `iterations` steps. Each frame after it runs `iterations` steps, or `first_iterations` / 15
    if that is more, until `first_iterations` are done."""
    newest_probability: Share = 0.2  # with so few iterations, 0.4 degrades older keyframes: 1 dB on redkitchen
    """Probability that a step uses the newest keyframe; the other steps use older ones, drawn uniformly."""
    weight_l1: NotNegative = 0.8
    """Weight of the loss |Ĉ − C|, colours in [0, 1] (VarSplat §2)."""
    weight_ssim: NotNegative = 0.2
    """Weight of the loss 1 − SSIM, which compares structure rather than brightness (VarSplat §2)."""
    weight_depth: NotNegative = 0.0
    """Weight of the loss |D̂ − D| in metres. Use less if the sensor's depth is worse than its colour (VarSplat §2)."""
    weight_mean_depth: NotNegative = 2.0
    """Weight of the loss |D̂/A − D| in metres where the alpha A is above ½ (ours). D̂/A is the mean depth of the splats;
    D̂ alone is too small where light passes the map. Instead of `weight_depth` it keeps splats on the surface."""
    weight_isotropy: NotNegative = 1.0
    """Weight of the loss |s − mean(s)| of the scales s in metres (VarSplat §2)."""
    weight_isotropy_ratio: NotNegative = 0.0
    """Weight of the loss max(s) / min(s) − 1 of the scales s (CG-SLAM eq. 17)."""
    weight_alignment: NotNegative = 0.0
    """Weight of the loss |D̂ − median depth| (CG-SLAM eq. 16)."""
    weight_moment: NotNegative = 0.1
    """Weight of the loss U, the variance of the splats' depths about the sensor's depth (CG-SLAM eq. 10)."""
    weight_nll_color: NotNegative = 0.01  # V predicts the errors better than with the paper's 1e-4
    """Weight of the negative log-likelihood of the colour error under V, which trains σ² (VarSplat §2); 0 = σ² is not
    learned from colour."""
    weight_nll_depth: NotNegative = 0.0
    """Weight of the negative log-likelihood of the depth error in metres; 0 = σ² is not learned from depth."""
    lr_means: NotNegative = 0.0002
    """Learning rate of positions, metres per step of Adam."""
    lr_means_first: NotNegative = 0.0
    """Learning rate of positions at the start of the first keyframe; it decays exponentially to `lr_means`. 0 =
    `lr_means` throughout."""
    lr_quats: ClassVar[float] = 1e-3
    """Learning rate of rotations: change of a unit quaternion's components per step."""
    # with 1e-2, discs on plain walls become balls: their depth is wrong from another side
    lr_log_scales: NotNegative = 0.0035
    """Learning rate of sizes: change of their logarithm per step; 0.005 is half a per cent."""
    lr_opacity_logits: NotNegative = 0.02  # seeds start nearly opaque, and steps of 0.05 would scatter their opacities
    """Learning rate of opacities: change of the logit per step."""
    lr_colors: ClassVar[float] = 2.5e-3
    """Learning rate of colours (0 to 1): change per step."""
    lr_log_variances: NotNegative = 0.02  # few iterations must change σ² as much as hundreds do in the paper
    """Learning rate of σ²: change of its logarithm per step. Use a higher one with few `iterations`, so that σ²
    converges."""
    lr_pose_translation: NotNegative = 0.0
    """Learning rate of keyframe positions in mapping, metres per step; 0 = positions are not optimised. The first pose
    is always fixed."""
    lr_pose_rotation: NotNegative = 0.0
    """Learning rate of keyframe rotations in mapping, radians per step; 0 = rotations are not optimised."""
    poses: Literal["all", "newest"] = "all"
    """Which poses mapping optimises: those of all keyframes in use (CG-SLAM eq. 21), or only the newest (CG-SLAM's
    code)."""
    poses_from: Literal["start", "half"] = "start"
    """When mapping optimises poses: in all steps of a keyframe, or only in the second half (CG-SLAM)."""
    freeze_old_colors: bool = False
    """Whether splats older than the keyframe keep their colours."""
    freeze_new_colors: bool = False
    """As VarSplat's code: the new splats of a keyframe keep the colour of their pixel, colours are frozen in the first
    half of its steps only, and each keyframe starts with a new Adam optimiser."""
    exposure: bool = False
    """Whether keyframes are mapped in the exposure of the map: the exposure that `tracking.exposure` found is removed
    from their colours (VarSplat's code for ScanNet)."""
    prune_opacity: Share = 0.05
    """Splats with at most this opacity are removed after the steps of a keyframe. A lower value keeps faint splats, a
    higher one makes holes."""
    window: Count = 0
    """Use only this many keyframes: the newest two, and those that overlap most with the newest (CG-SLAM's
    sliding-window bundle adjustment). 0 = all, drawn at random (VarSplat)."""
    covisibility: Literal["splats", "descriptor"] = "splats"
    """How the overlap of the window's keyframes is measured: by common dominant splats, or by the image
    descriptor of `loops`."""
    sensor_noise: bool = False
    """Whether the losses of depth weigh each reading by how many times as sure it is as the law of
    `render.depth_noise_per_m` says (`input.sensor`), at most 4 times."""
    frames_per_step: Count = 1
    """Each step minimises the mean loss of this many keyframes of the window; 0 = of all of them (CG-SLAM)."""

    @property
    def freeze_until(self) -> Literal["end", "half"]:
        """How long colours are frozen: in all steps of a keyframe, or only in the first half (VarSplat's code)."""
        return "half" if self.freeze_new_colors else "end"

    @property
    def fresh_adam(self) -> bool:
        """Whether each keyframe starts with a new Adam optimiser, without earlier moments (VarSplat's code)."""
        return self.freeze_new_colors

    @property
    def first_per_frame(self) -> int:
        """Return how many steps of the first keyframe a later frame makes (`divided`)."""
        return max(self.iterations, self.first_iterations // FIRST_FRAMES)

    @property
    def in_halves(self) -> bool:
        """Return whether the second half of a keyframe's steps is left to the next frames (`divided`)."""
        return self.divided and not (self.lr_pose_translation or self.lr_pose_rotation)

    @property
    def half_per_frame(self) -> int:
        """Return how many steps of the second half of a keyframe a later frame makes (`divided`), so that they are
        made before the next keyframe."""
        return ceil((self.iterations - self.iterations // 2) / max(self.every - 1, 1))


@dataclass(frozen=True)
class DensifyConfig(Section, name="primitives"):
    """Pruning, splitting and cloning of splats, halfway through the steps of a keyframe and after them (CG-SLAM §4,
    5)."""

    uncertain_m2: NotNegative = 0.025
    """A splat is uncertain if the mean squared difference between its depth and the depth readings at its pixels, over
    the window, is above this (ν > τ, CG-SLAM eq. 13). It fades halfway through the steps of a keyframe, and is removed
    at the end unless it has recovered; 0 = off."""
    owner: Literal["dominant", "median"] = "dominant"
    """Which splat of a pixel is compared with its depth reading: the one with the largest weight (paper), or the one at
    the median depth (CG-SLAM's code)."""
    faded_opacity: ClassVar[float] = 0.07
    """Opacity of a faded splat. It is above `render.alpha_min`, so that the splat is still drawn and can recover
    (ours)."""
    least_opacity: ClassVar[float] = 15.0 / 255.0
    """A faded splat has recovered if it is no longer uncertain and has at least this opacity (CG-SLAM's α_min)."""
    split_gradient: NotNegative = 0.0
    """A splat is densified if the mean gradient of the loss with respect to its 2D position in the newest keyframe is
    at least this, per half image size (3DGS); 0 = no splat is split or cloned for its gradient."""
    split_scale_m: NotNegative = 0.05
    """A densified splat larger than this is split in two."""
    split_radius_px: NotNegative = 13.0  # else an inherited map becomes coarser as the camera moves
    """A splat whose radius (three standard deviations) in the newest keyframe's image exceeds this is split in two as
    well: it was made for a view from farther away (ours). 0 = off."""
    clone: bool = False
    """Whether a densified splat that is too small to be split is cloned (3DGS; not in CG-SLAM's code)."""
    most_scale_m: NotNegative = 0.0
    """Splats larger than this are removed; 0 = off."""


@dataclass(frozen=True)
class TrackingConfig(Section, name="tracking"):
    """Fit of camera poses: method, iterations, masks, weights (VarSplat §3; CG-SLAM §6)."""

    method: Literal["adam", "align"] = "align"  # Gauss–Newton on images instead of 200 renders per frame
    """adam: gradient descent through the renderer, as in the papers; align: one render, then Gauss–Newton on that
    image."""
    iterations: Count = 200
    """Maximum number of Adam steps per frame. Use more for fast or shaky motion, fewer for speed."""
    align_iterations: ClassVar[int] = 15
    """Maximum number of Gauss–Newton steps per pyramid level."""
    align_depth_by: Literal["V", "U"] = "V"
    """Whether alignment weights depth residuals by V, like gray residuals, or in the same way by the depth variance U
    of the map (CG-SLAM eq. 10)."""
    align_stop: ClassVar[float] = 2e-4
    """Alignment ends the finest pyramid level when a step is smaller than this (metres and radians). The limit doubles
    from each level to the next coarser one."""
    align_weight_color: Share = 0.1  # gray has the smaller basin of convergence; with 0.5, steps of 5° fail
    """Weight of gray residuals in alignment; depth residuals have 1 minus this."""
    amsgrad: bool = False
    """Whether Adam divides by the largest second moment so far (AMSGrad, VarSplat's code). On a CUDA device such a
    descent runs on the host."""
    parametrisation: Literal["quaternion", "axis-angle"] = "quaternion"
    """What Adam optimises: a quaternion and a translation relative to the initial guess (VarSplat's code), or the
    axis-angle rotation and the position of the camera (CG-SLAM)."""
    first_iterations: Count = 0
    """Number of Adam steps for the second frame, which has no motion model yet, with a rotation of 3e-3 rad per step
    (CG-SLAM's code); 0 = as for other frames."""
    lr_rotation: NotNegative = 2e-3
    """Learning rate of rotation, radians per step; with quaternions the angle per step is twice as large. Use a higher
    one for fast motion."""
    lr_translation: NotNegative = 1e-2
    """Learning rate of translation, metres per step."""
    weight_color: Share = 0.6
    """λ_c, the weight of the colour loss; the depth loss has 1 − λ_c."""
    uncertainty: bool = True
    """Whether pixels are weighted by exp(−(log V − median)/τ); off = LoopSplat."""
    tau: Above0 = 10.0
    """τ of the pixel weights, in units of log V: at 50, a V of ten times the median lowers the weight by 5 %. A smaller
    τ gives V more influence."""
    weight_max: ClassVar[float] = 3.0
    """Bounds of the pixel weights: at most this, at least 1 / this."""
    alpha_power: NotNegative = 3.0
    """Pixels are weighted by the rendered alpha to this power. A higher one ignores parts where the map is thin."""
    alpha_above: NotNegative = 0.0
    """Only pixels with a rendered alpha above this are used; 0 = off."""
    outlier_factor: NotNegative = 50.0
    """Only pixels with a depth error below this multiple of its median are used; 0 = off."""
    average: Literal["image", "kept"] = "image"
    """Whether the errors of colour and depth are averaged over all pixels, or over the pixels that each of them uses:
    colour where its error is no outlier (CG-SLAM)."""
    reinit_factor: NotNegative = 5.0
    """If the first loss exceeds this multiple of its running median, tracking restarts from odometry with twice the
    iterations."""
    exposure: bool = False
    """Whether a factor and an offset of the colour are fitted with the pose, for cameras that change their exposure."""
    lr_exposure: ClassVar[float] = 0.01
    """Learning rate of the exposure: change per step of the factor's logarithm and of the offset (colours 0 to 1)."""
    features: bool = True
    """Whether sparse features give a second guess of the pose where motion is wide or the first fit is doubtful (ours).
    The same fit starts from each guess, and the result that explains more is used."""
    verify: bool = True
    """Whether a pose is judged by comparing surfaces at it (ours); off = by agreement and overlap only. It needs
    `method` align. Alignment then uses the part of σ that depends on the distance, by the model of `input.sensor`,
    instead of the law of `render.depth_noise_per_m`, also for loops and where a lost camera is searched for."""
    lost_agreement: ClassVar[float] = 0.6
    """Tracking is lost if map and sensor agree in depth on less than this share of the pixels where both have a
    surface; not used with `verify`."""
    lost_share: ClassVar[float] = 0.2
    """Tracking is lost if the map agrees with less than this share of the sensor's readings (agreement × overlap); with
    `verify`, if reference and frame have less than this share of the reference's readings in common."""
    fit_depth: bool = False
    """Whether the depth of each frame is fitted to the map and to other views before it is used, because its scale is
    arbitrary. `run` sets it for depth that a network predicted."""
    plateau_stop: NotNegative = 0.0
    """Adam stops when `plateau_window` steps have not lowered the loss by this share; a level of alignment stops when
    one step changes the loss by less than this share; 0 = off."""
    plateau_window: AtLeastOne = 10
    """Number of Adam steps within which the loss must fall by the share `plateau_stop`."""
    cuda_graphs: ClassVar[bool] = True
    """On a CUDA device, whether several iterations of descent are launched as one CUDA graph; off = each kernel is
    launched on its own."""

    def without_motion(self) -> "TrackingConfig":
        """Return the settings for the second frame of a sequence, which has no motion model yet (CG-SLAM's code)."""
        if not self.first_iterations:
            return self
        return replace(self, iterations=self.first_iterations, lr_rotation=self.first_lr_rotation)

    @property
    def sensor_noise(self) -> bool:
        """Whether alignment uses the model of `input.sensor`: with `verify`."""
        return self.verify

    @property
    def outlier_factor_color(self) -> float:
        """Colour counts only where its error, summed over channels, is below this multiple of its median; 0 = off."""
        return 10.0 if self.average == "kept" else 0.0

    @property
    def first_lr_rotation(self) -> float:
        """Learning rate of rotation for the second frame; 0 = as for other frames."""
        return 3e-3 if self.first_iterations else 0.0
