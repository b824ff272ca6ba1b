"""Settings of the work per submap: when to start a new one, loops, registration, the final map."""

import sys
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from sigmasplat.config.ranges import (
    WIDTHS_PX,
    Above0,
    AtLeastOne,
    Count,
    NotNegative,
    Range,
    Section,
    Share,
    shown,
)
from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class SubmapConfig(Section, name="submaps"):
    """Rules that end the active submap and start the next one; checked at each keyframe (VarSplat §2)."""

    distance_m: NotNegative = 0.5
    """A new submap starts if the camera is farther than this from the submap's first pose, or has rotated by more than
    `angle_deg`; 0 = off. If all rules are off, the map is one submap."""
    frames: Count = 0
    """A new submap starts this many frames after the first one of the active submap; 0 = off."""
    uncertainty_m: NotNegative = 0.02
    """A new submap starts if the standard deviation of the camera's position in the submap, accumulated from keyframe
    to keyframe, exceeds this (`slam.drift`); 0 = off."""
    inherit: bool = True  # starting a submap empty costs two seconds of first iterations
    """Whether a new submap starts with copies of the splats in view, which are then mapped like any others; off = it
    starts empty (paper)."""

    @property
    def angle_deg(self) -> float:
        """A new submap starts if the camera has rotated by more than this from the submap's first pose; 0 = off."""
        return 50.0 if self.distance_m else 0.0


@dataclass(frozen=True)
class LoopConfig(Section, name="loops"):
    """Selection of submaps that may show the same place (VarSplat §4)."""

    close: bool = True
    """Whether loops are searched and closed."""
    descriptor: Literal["grid", "netvlad", "netvlad-or-grid"] = "grid"
    """Image descriptor: grid = built in (`slam.loop_closure.descriptors.OrientationGrid`); netvlad = with the weights
    of the file `weights`; netvlad-or-grid = NetVLAD (papers) if `weights` is set, otherwise the built-in one, with a
    warning."""
    weights: str = ""
    """File of NetVLAD weights, needed by descriptor=netvlad; read at the start."""
    min_similarity: Share = 0.5
    """Sets the similarity that a loop must exceed: the k-th highest similarity of a keyframe to the keyframes of its
    own submap, where k is this share of their number."""
    min_interval: AtLeastOne = 2
    """Two submaps are tested as a loop only if their numbers differ by at least this."""
    similarity_floor: NotNegative = 0.8  # the built-in descriptor needs it: it describes shapes, not places
    """Pairs of keyframes with a similarity of at most this are never tested."""
    near_m: NotNegative = 0.5  # the built-in descriptor rarely recognises a place from another side
    """Keyframes closer than this by the current poses are tested too, whatever their similarity; 0 = off (paper)."""
    near_deg: Annotated[float, Range(0, 180)] = 30.0
    """Maximum rotation between the keyframes of a pair that `near_m` selects."""
    most: Count = 3  # registering a pair costs as much as thirty frames
    """Maximum number of pairs registered per finished submap, the most similar first; 0 = no limit."""
    slices_per_frame: Count = 3
    """Each frame that is not a keyframe continues the search for the loops of finished submaps by this many slices for
    each submap that waits, so that no frame takes long. A slice is one alignment. 0 = the frame that ends the submap
    makes the whole search."""
    uncertainty: bool = True
    """Whether similarity is multiplied by a gate from the variance-weighted opacity ratio; off = LoopSplat."""
    tau: Above0 = 10.0
    """τ of the splat weights in that opacity ratio, computed from σ². A smaller τ separates certain from uncertain
    splats more sharply."""
    weight_max: ClassVar[float] = 3.0
    """Bounds of the splat weights in the opacity ratio: at most this, at least 1 / this."""


@dataclass(frozen=True)
class RegistrationConfig(Section, name="registration"):
    """Registration of two submaps, and acceptance of the result (VarSplat §5)."""

    keyframes: ClassVar[int] = 2
    """Number of keyframes of each submap that are localised in the other one."""
    iterations: Count = 0  # descent hardly ever finds what alignment does not, and takes half of a search
    """Maximum number of Adam steps per keyframe, after alignment; each step is a render. 0 = only alignment."""
    lr_rotation: NotNegative = 0.001
    """Learning rate of rotation in registration, as `tracking.lr_rotation`."""
    lr_translation: NotNegative = 0.001
    """Learning rate of translation in registration, metres per step."""
    plateau_stop: NotNegative = 1e-4
    """The steps of registration end when `plateau_window` steps have not lowered the loss by this share; 0 = run every
    iteration."""
    plateau_window: AtLeastOne = 10
    """Number of steps within which the loss of registration must fall by the share `plateau_stop`."""
    target: Literal["recorded", "rendered"] = "recorded"
    """Which image of a keyframe is localised in the other submap: the recorded one, or the one that its own submap
    renders at its pose (VarSplat's code for ScanNet)."""
    to_keyframe: bool = True
    """Whether a localised keyframe is finally aligned to the recorded image of the other submap's nearest keyframe
    (ours): the surfaces of a young map are biased. A loop that only the maps show is rejected. off = the pose relative
    to the map is used (paper)."""
    exposure: ClassVar[bool] = True
    """Whether a factor and an offset of the colour are fitted too, because submaps may differ in exposure."""
    weight_color: ClassVar[float] = 0.95
    """λ_c, the weight of the colour loss in registration; the depth loss has 1 − λ_c."""
    color_mean: Literal["values", "pixels"] = "pixels"
    """How the colour errors of registration are averaged: values = over pixels and channels (paper); pixels = over
    pixels, with the sum over the three channels, which weights colour three times as much."""
    uncertainty: bool = True
    """Whether pixels are weighted by the V of the other submap; off = LoopSplat."""
    tau: Above0 = 10.0
    """τ of the pixel weights in registration, as `tracking.tau`."""
    weight_max: ClassVar[float] = 3.0
    """Bounds of the pixel weights in registration: at most this, at least 1 / this."""
    overlap_least: ClassVar[float] = 0.2
    """A loop is rejected if less than this share of the splats has a neighbour within `overlap_m` in the other
    submap."""
    overlap_m: ClassVar[float] = 0.1
    """Maximum distance in metres, times the scale of the scene, between a splat and its neighbour in the other submap,
    for `overlap_least`: about the distance between two maps of the same wall."""
    agreement_least: ClassVar[float] = 0.8
    """A localisation is valid only if at least this share of the common surface agrees in depth."""
    share_least: ClassVar[float] = 0.3
    """A localisation is valid only if the other submap explains at least this share of its depth readings."""
    spread_m: ClassVar[float] = 0.1
    """Localisations agree if they are within this distance of one of them, in metres, times the scale of the scene. A
    loop is rejected if fewer than two agree."""
    spread_deg: ClassVar[float] = 5.0
    """Localisations agree if their rotations differ from one of them by at most this. A loop is rejected if fewer than
    two agree."""


@dataclass(frozen=True)
class FinalConfig(Section, name="final"):
    """The global map, made from all submaps after the last frame (VarSplat §7)."""

    seed_from: Literal["submaps", "mesh"] = "submaps"
    """Initial splats of the final map: submaps = the splats of the submaps; mesh = new splats on the fused surface
    (paper)."""
    iterations: Count = 1000
    """Number of refinement steps over all keyframes; 0 = no refinement."""
    lr_pose_translation: NotNegative = 0.0003
    """Learning rate of keyframe positions during refinement, in metres; the poses of frames follow their keyframes. 0 =
    fixed (paper)."""
    lr_pose_rotation: NotNegative = 0.0002
    """Learning rate of keyframe rotations during refinement, in rad; 0 = fixed (paper)."""
    pose_reach_m: NotNegative = 0.001  # without a limit, refinement bends a path that tracking found to a millimetre
    """About how far refinement can move a keyframe from its tracked pose, in metres: each step takes back
    the share `final.lr_pose_translation` / `final.pose_reach_m` of this motion and turn. 0 = without limit."""
    pose_reach_most_m: NotNegative = 0.01  # where tracking is less sure, views are 0.2 to 0.3 dB sharper
    """If above `final.pose_reach_m`, the reach is half the median standard deviation of the keyframe positions, limited
    to the range from `final.pose_reach_m` to this value, in metres. The learning rates of poses grow in proportion. 0 =
    the reach is always `final.pose_reach_m`."""
    seconds: NotNegative = 0.0
    """Time budget of the refinement in seconds: it ends at the latest then, even if steps are left, and learning rates
    fall in time. The result then depends on the speed of the machine. 0 = no limit."""
    exposure: bool = True
    """Whether the exposure of each keyframe relative to the map is fitted during refinement: a gain and an offset for
    each colour channel. Frames between keyframes get an interpolated exposure."""
    order: Literal["random", "epochs"] = "epochs"
    """Order of the keyframes in refinement, and what belongs to it: random = drawn for each of many steps at the rates
    of mapping (paper); epochs = every keyframe once, in random order, before any is used again, for few steps at rates
    that fall, without U, without hidden splats, and with limits on the shapes of splats (ours)."""
    lr_means_last: NotNegative = 0.0
    """Learning rate of positions in the last refinement step; it decays exponentially from `mapping.lr_means` (3DGS). 0
    = `mapping.lr_means` throughout."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Degree of view-dependent colour reached during refinement, 0 to 3."""
    sh_every: AtLeastOne = 100
    """Number of refinement steps after which the degree of view-dependent colour rises by one."""
    spacing_m: Above0 = 0.02
    """Distance between the splats seeded on the mesh."""
    merge_m: Above0 = 0.05  # 40 % fewer splats than with 0.02, and no seams between neighbouring voxels
    """Edge in metres of the voxels in which merging keeps the splats of one submap only."""
    max_splats: Count = 0
    """Largest number of splats of the final map; those that contribute least to the images of keyframes are removed. 0
    = no limit."""
    prune_every: ClassVar[int] = 500
    """Number of refinement steps between removals of splats with low opacity (`prune_opacity`)."""
    prune_opacity: ClassVar[float] = 0.005
    """Splats with at most this opacity, 0 to 1, are removed during refinement."""
    width: str = "working"
    """Width of the images in the last stage of refinement: working = no such stage, only working images are used;
    camera = as recorded; or a number of pixels, at most the recorded width. If it is above `input.width`, the colour of
    each keyframe is kept at this size."""
    width_iterations: Count = 8000
    """Number of refinement steps of the stage with images of `width`, after those of `iterations`, if `iterations` is
    above 0. Two thirds of them use working images, so that the map stays sharp at that size too."""
    uncertainty: bool = True
    """Whether variance is used to merge submaps and still learned during refinement; off = paper."""

    @property
    def short(self) -> bool:
        """Return whether refinement has few steps (`order`)."""
        return self.order == "epochs"

    @property
    def lr_factor(self) -> float:
        """Factor on the learning rates of mapping (`mapping.lr_…`) in the first refinement step, except that of
        positions. The rates of mapping are too small for 1000 steps: shapes hardly change."""
        return 12.0 if self.short else 1.0

    @property
    def lr_log_scales(self) -> float:
        """Learning rate of sizes in the first refinement step; with half of it, views are up to 0.2 dB less sharp. 0 =
        `final.lr_factor` times `mapping.lr_log_scales`."""
        return 0.08 if self.short else 0.0

    @property
    def lr_decay(self) -> float:
        """Learning rates of splats and poses in the last refinement step, as a share of those in the first; they decay
        exponentially. 1 = constant."""
        return 0.05 if self.short else 1.0

    @property
    def beta2(self) -> float:
        """Decay β₂ of Adam's second moment during refinement. With 0.99 the size of a step follows the last hundred
        gradients: each keyframe has about a dozen steps, and 0.999 remembers gradients of the merged map."""
        return 0.99 if self.short else 0.999

    @property
    def prune_weight_px(self) -> float:
        """Before and after refinement, splats are removed if their weights in every keyframe sum to less than this, in
        pixels. 0 = none are removed."""
        return 0.5 if self.short else 0.0

    @property
    def weight_moment(self) -> bool:
        """Whether the depth uncertainty U stays in the loss of refinement (`mapping.weight_moment`). It does not
        improve a map of few steps, and costs an eighth of the time."""
        return not self.short

    @property
    def max_axis_ratio(self) -> float:
        """Largest ratio of a splat's longest axis to its shortest; refinement lengthens shorter axes. 0 = no limit."""
        return 19.0 if self.short else 0.0

    @property
    def max_needle_ratio(self) -> float:
        """Largest ratio of a splat's longest axis to its second longest; refinement shortens the longest. 0 = no
        limit."""
        return 8.0 if self.short else 0.0

    @property
    def width_px(self) -> int:
        """Return `width` in pixels; 0 = working, a very large number = camera. Raises ConfigError on other text."""
        named = {"working": 0, "camera": sys.maxsize}
        if self.width in named:
            return named[self.width]
        pixels = int(self.width) if self.width.isdecimal() and len(self.width) < 6 else -1
        if pixels not in WIDTHS_PX:
            raise ConfigError(
                f"final.width must be working, camera or a number of pixels ({WIDTHS_PX}), found {shown(self.width)}"
            )
        return pixels

    def problems(self) -> list[str]:
        """Describe each invalid value, and a `width` that is neither a word nor a number of pixels."""
        found = super().problems()
        if isinstance(self.width, str):
            try:
                _ = self.width_px
            except ConfigError as problem:
                found.append(str(problem))
        return found
