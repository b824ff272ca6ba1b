"""Settings of the map of a submap: rendering, seeding, mapping, and when splats are pruned or split."""

from dataclasses import dataclass
from math import ceil
from typing import ClassVar, Literal, NamedTuple

from sigmasplat.config.ranges import Above0, AtLeastOne, Count, FromRow, NotNegative, Section, Share

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
    depth: Literal["center", "ray"] = "ray"
    """Depth of a splat at a pixel: center = that of its centre (papers); ray = where the ray meets it most densely, so
    that a flat splat can show a slanted surface (RaDe-GS)."""
    scene_scale: Above0 = 1.0
    """Size of the scene relative to a room: factor on fixed limits in metres, such as the gates of alignment. `run`
    sets it for stereo recordings, together with all settings that are lengths."""
    depth_noise_per_m: Above0 = 0.003
    """Standard deviation of depth readings z is assumed to be this times z², per metre. 0.003 is a structured-light
    sensor (Khoshelham & Elberink 2012). `run` sets σ_d/(f·b) for stereo recordings."""
    covariance_pose_gradient: bool = True
    """Whether the pose gradient includes the path through the 2D covariance."""

    @property
    def low_pass_px2(self) -> float:
        """Added to the diagonal of the 2D covariance, in px²: that of 3DGS."""
        return 0.3


class SeedShape(NamedTuple):
    """What belongs to a shape of seeds."""

    scale_from: str
    """What their initial size follows: the nearest splats (neighbours), or the size of a pixel (pixel)."""
    scale_factor: float
    """Factor on this size. A larger one closes gaps, a smaller one keeps edges."""
    thickness: float
    """Size along the surface's normal, as a share of the size along the surface; 1 = a sphere."""
    opacity: float
    """Initial opacity, 0 to 1. With a higher value the map can be used for tracking sooner."""
    density: float
    """Share of the chosen pixels of a later keyframe that become splats; more of them only take more time."""
    push_back: float = 1.005
    """Factor on the depth of seeds: blending with closer splats makes rendered depth small (VarSplat's code)."""


SEED_SHAPES = {
    "neighbours": SeedShape("neighbours", 1.0, 1.0, 0.5, 1.0, push_back=1.0),
    "neighbours-behind": SeedShape("neighbours", 1.0, 1.0, 0.5, 1.0),
    # searching the map for neighbours costs more than fitting a keyframe
    "pixel": SeedShape("pixel", 0.8, 1.0, 0.8, 0.35),
    # with the slower change of sizes, larger seeds blur submaps; the depth of a disc seen at an angle is right, and the
    # path a little better
    "disc": SeedShape("pixel", 0.65, 0.1, 0.8, 0.35),
}
"""The values that belong to each `seeding.shape`: of VarSplat and CG-SLAM, of VarSplat's code, and ours."""


@dataclass(frozen=True)
class SeedConfig(Section, name="seeding"):
    """Creation of new splats (VarSplat §2, seeding)."""

    first_uniform: Count = 40_000  # half of 320×240: more splats add cost but no accuracy
    """Number of pixels of the first keyframe, drawn uniformly, that become splats. Use more for large images, fewer for
    speed."""
    first_gradient: Count = 15_000
    """Number of additional pixels of the first keyframe, drawn in proportion to the image gradient, that become
    splats."""
    later_max: Count = 0
    """Maximum number of new splats per later keyframe; 0 = no limit."""
    alpha_below: Share = 0.6
    """Pixels of a later keyframe are seeded where the rendered alpha of the map is below this."""
    depth_error_factor: NotNegative = 40.0
    """Pixels are seeded too where the rendered surface is behind the measured one by this multiple of the median depth
    error; 0 = off (CG-SLAM)."""
    depth_error_least_m: NotNegative = 0.1  # 40 × a median of 2 mm alone would treat sensor noise as a new surface
    """Minimum distance, in metres, between rendered and measured surface for seeding by `depth_error_factor`."""
    min_distance_m: NotNegative = 0.01
    """No seed is placed closer than this to an existing splat in view."""
    shape: Literal["neighbours", "neighbours-behind", "pixel", "disc"] = "disc"
    """Shape and size of seeds: neighbours = spheres, as large as the root mean squared distance to the 3 nearest splats
    (papers); neighbours-behind = the same, 0.5 % farther than the reading (VarSplat's code); pixel = fewer and more
    opaque spheres, of 0.8 × a pixel at that depth × the spacing of the seeds; disc = the same with 0.65, as discs on
    the surface that the depth image shows, a tenth as thick, and wider where they are seen at an angle."""
    outliers: Literal["keep", "remove", "remove-later"] = "keep"
    """Whether seeds far from their 40 nearest neighbours are removed; remove-later = not from the seeds of an empty map
    (VarSplat's code)."""
    max_splats: Count = 250_000
    """Maximum number of splats in a submap; 0 = no limit."""

    scale_from = FromRow[str]("shape", SEED_SHAPES)
    scale_factor = FromRow[float]("shape", SEED_SHAPES)
    thickness = FromRow[float]("shape", SEED_SHAPES)
    opacity = FromRow[float]("shape", SEED_SHAPES)
    density = FromRow[float]("shape", SEED_SHAPES)
    push_back = FromRow[float]("shape", SEED_SHAPES)

    @property
    def first_edges(self) -> bool:
        """Whether all pixels on and beside Canny edges of the first keyframe become splats too (VarSplat). Sampling by
        gradient alone finds nearly the same."""
        return self.scale_from == "neighbours" and self.first_gradient > 0

    @property
    def outlier_neighbours(self) -> int:
        """Number of neighbours for statistical outlier removal; 0 = off."""
        return 0 if self.outliers == "keep" else 40

    @property
    def outlier_first(self) -> bool:
        """Whether outliers are also removed from the seeds of an empty map."""
        return self.outliers != "remove-later"


class Adjustment(NamedTuple):
    """What belongs to a way of fitting keyframes and poses together."""

    frames_per_step: int
    """Each step minimises the mean loss of this many keyframes of the window; 0 = of all of them."""
    poses: str
    """Which poses move: those of all keyframes in use (all), or only the newest."""
    poses_from: str
    """When they move: in all steps of a keyframe (start), or only in the second half (half)."""
    covisibility: str
    """How the overlap of the window's keyframes is measured: by common dominant splats, or by the image descriptor."""


ADJUSTMENTS = {
    "single": Adjustment(1, "all", "start", "splats"),
    "single-late": Adjustment(1, "all", "half", "splats"),
    "window": Adjustment(0, "all", "half", "splats"),
    "window-newest": Adjustment(0, "newest", "half", "descriptor"),
}
"""The values that belong to each `mapping.adjustment`. Paper and code of CG-SLAM choose the window by NetVLAD, whose
weights are a download; common splats need none."""


@dataclass(frozen=True)
class MappingConfig(Section, name="mapping"):
    """Fit of the map to keyframes: iterations, loss weights, learning rates (VarSplat §2; CG-SLAM §3, 5, 7)."""

    every: AtLeastOne = 5  # mapping every frame would take five times as long
    """A frame becomes a keyframe this many frames after the last keyframe."""
    overlap_below: NotNegative = 0.75  # more keyframes when the camera moves fast
    """A frame also becomes a keyframe if its overlap with the newest keyframe is below this, or if the image has moved
    by an eighth of its width; 0 = neither."""
    iterations: Count = 8  # the final map is as good as with 15; the submaps have up to 1 dB less
    """Optimisation steps per keyframe: the first setting to change to trade speed for quality."""
    first_iterations: Count = 80  # the rendered depth has no bias from here on; without D̂/A it takes 150
    """Optimisation steps for the first keyframe of a map. Until about 150 steps, a new map renders surfaces too close,
    with `weight_mean_depth` until about 75."""
    divided: bool = True
    """Whether the steps of a keyframe, and the search for the loops of finished submaps, are spread over frames, so
    that no frame takes much longer than others. Half of the steps run at the keyframe, half during the next frames; all
    at the keyframe if mapping moves poses (`lr_pose_*`), from which the next frames are tracked. The first keyframe of
    a map runs `iterations` steps, and each frame after it as many, but at least a 15th of `first_iterations`, until
    these are done."""
    few_steps: bool = True
    """Whether rates and draws suit few steps per keyframe: σ² and opacities then change as much as with hundreds of
    steps, and older keyframes are drawn more often; off = papers."""
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
    weight_moment: NotNegative = 0.0
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
    lr_colors: ClassVar[float] = 2.5e-3
    """Learning rate of colours (0 to 1): change per step."""
    lr_pose_translation: NotNegative = 0.0
    """Learning rate of keyframe positions in mapping, metres per step; 0 = positions are not optimised. The first pose
    is always fixed."""
    lr_pose_rotation: NotNegative = 0.0
    """Learning rate of keyframe rotations in mapping, radians per step; 0 = rotations are not optimised."""
    adjustment: Literal["single", "single-late", "window", "window-newest"] = "single"
    """What a step fits, and which poses it moves if `lr_pose_*` are above 0: single = one keyframe and its pose, in
    all steps of a keyframe (VarSplat); single-late = poses only in the second half; window = all keyframes of `window`
    together, poses in the second half (CG-SLAM eq. 21); window-newest = the same with the newest pose alone, and a
    window by the similarity of image descriptors (CG-SLAM's code)."""
    colors: Literal["free", "old-frozen", "code"] = "free"
    """How colours are fitted: all of them (free); splats older than the keyframe keep theirs (old-frozen, VarSplat); as
    VarSplat's code: all are frozen in the first half of a keyframe's steps, each keyframe starts with a new Adam
    optimiser, and the exposure that `tracking.exposure` found is removed from it."""
    prune_opacity: Share = 0.05
    """Splats with at most this opacity are removed after the steps of a keyframe. A lower value keeps faint splats, a
    higher one makes holes."""
    window: Count = 0
    """Use only this many keyframes: the newest two, and those that overlap most with the newest (CG-SLAM's
    sliding-window bundle adjustment). 0 = all, drawn at random (VarSplat)."""

    frames_per_step = FromRow[int]("adjustment", ADJUSTMENTS)
    poses = FromRow[str]("adjustment", ADJUSTMENTS)
    poses_from = FromRow[str]("adjustment", ADJUSTMENTS)
    covisibility = FromRow[str]("adjustment", ADJUSTMENTS)

    @property
    def newest_probability(self) -> float:
        """Probability that a step uses the newest keyframe; the other steps use older ones, drawn uniformly. With few
        steps, 0.4 degrades older keyframes: 1 dB on redkitchen."""
        return 0.2 if self.few_steps else 0.4

    @property
    def lr_opacity_logits(self) -> float:
        """Learning rate of opacities: change of the logit per step. Seeds of `seeding.shape` pixel or disc start nearly
        opaque, and steps of 0.05 would scatter their opacities."""
        return 0.02 if self.few_steps else 0.05

    @property
    def lr_log_variances(self) -> float:
        """Learning rate of σ²: change of its logarithm per step."""
        return 0.02 if self.few_steps else 0.0025

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
    faded_opacity: ClassVar[float] = 0.07
    """Opacity of a faded splat. It is above `render.alpha_min`, so that the splat is still drawn and can recover
    (ours)."""
    least_opacity: ClassVar[float] = 15.0 / 255.0
    """A faded splat has recovered if it is no longer uncertain and has at least this opacity (CG-SLAM's α_min)."""
    densify: Literal["off", "split", "split+clone"] = "off"
    """Whether splats are densified if the mean gradient of the loss with respect to their 2D position in the newest
    keyframe is at least 0.002 per half image size (3DGS): large ones are split in two, small ones cloned (not in
    CG-SLAM's code)."""
    split_scale_m: NotNegative = 0.05
    """A densified splat larger than this is split in two; with `densify`, splats ten times as large are removed."""
    split_radius_px: NotNegative = 13.0  # else an inherited map becomes coarser as the camera moves
    """A splat whose radius (three standard deviations) in the newest keyframe's image exceeds this is split in two as
    well: it was made for a view from farther away (ours). 0 = off."""

    @property
    def split_gradient(self) -> float:
        """A splat is densified if the mean gradient of its 2D position is at least this; 0 = none is."""
        return 0.0 if self.densify == "off" else 0.002

    @property
    def clone(self) -> bool:
        """Whether a densified splat that is too small to be split is cloned."""
        return self.densify == "split+clone"

    @property
    def most_scale_m(self) -> float:
        """Splats larger than this are removed; 0 = off."""
        return 0.0 if self.densify == "off" else 10.0 * self.split_scale_m
