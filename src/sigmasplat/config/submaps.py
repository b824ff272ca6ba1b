"""Settings of the work per submap: when to start a new one, loops, registration; of the final map, its surface and its
uncertainty."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

from sigmasplat.config.ranges import (
    WIDTHS_PX,
    Above0,
    AtLeastOne,
    Count,
    FromRow,
    NotNegative,
    Range,
    Section,
    Share,
)


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
    to keyframe, exceeds this (`tracking.drift`); 0 = off."""
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
    """Image descriptor: grid = built in (`tracking.descriptors.OrientationGrid`); netvlad = with the weights
    of the file `weights`; netvlad-or-grid = NetVLAD (papers) if `weights` is set, otherwise the built-in one, with a
    warning."""
    weights: str = ""
    """File of NetVLAD weights, needed by descriptor=netvlad; read at the start."""
    min_similarity: Share = 0.5
    """Sets the similarity that a loop must exceed: the k-th highest similarity of a keyframe to the keyframes of its
    own submap, where k is this share of their number."""
    min_interval: AtLeastOne = 2
    """Two submaps are tested as a loop only if their numbers differ by at least this."""
    near_m: NotNegative = 0.5  # the built-in descriptor rarely recognises a place from another side
    """Keyframes closer than this by the current poses are tested too, whatever their similarity; 0 = off (paper)."""
    near_deg: ClassVar[float] = 30.0
    """Maximum rotation between the keyframes of a pair that `near_m` selects."""
    most: Count = 3  # registering a pair costs as much as thirty frames
    """Maximum number of pairs registered per finished submap, the most similar first; 0 = no limit."""
    alignments: ClassVar[int] = 8
    """At the end each keyframe is aligned to at most this many earlier ones that see the same, and all poses are solved
    together (ours), if `final.move_poses` is on; not if `close` is off, nor if poses are given."""
    uncertainty: bool = True
    """Whether similarity is multiplied by a gate from the variance-weighted opacity ratio; off = LoopSplat."""
    tau: Above0 = 10.0
    """τ of the splat weights in that opacity ratio, computed from σ². A smaller τ separates certain from uncertain
    splats more sharply."""
    weight_max: ClassVar[float] = 3.0
    """Bounds of the splat weights in the opacity ratio: at most this, at least 1 / this."""

    @property
    def similarity_floor(self) -> float:
        """Pairs of keyframes with a similarity of at most this are never tested. The built-in descriptor needs it: it
        describes shapes, not places."""
        return 0.8 if self.descriptor == "grid" else 0.0


class RegistrationRow(NamedTuple):
    """What belongs to a way of localising keyframes."""

    lr_rotation: float
    """Learning rate of rotation, as `tracking.lr_rotation`."""
    lr_translation: float
    """Learning rate of translation, metres per step, times the scale of the scene."""
    color_mean: str
    """How the colour errors are averaged: over pixels and channels (values); or over pixels, with the sum over the
    three channels, which weights colour three times as much (pixels)."""
    target: str = "recorded"
    """Which image of a keyframe is localised: the recorded one, or the one that its own submap renders (rendered)."""


REGISTRATIONS = {
    "keyframe": RegistrationRow(0.001, 0.001, "pixels"),
    "few-steps": RegistrationRow(0.001, 0.001, "pixels"),
    "paper": RegistrationRow(0.015, 0.005, "values"),
    "paper-fine": RegistrationRow(0.003, 0.001, "values"),
    "rendered": RegistrationRow(0.015, 0.005, "values", "rendered"),
}
"""The values that belong to each `registration.method`: of the paper, its code, or ours."""


@dataclass(frozen=True)
class RegistrationConfig(Section, name="registration"):
    """Registration of two submaps, and acceptance of the result (VarSplat §5)."""

    keyframes: ClassVar[int] = 2
    """Number of keyframes of each submap that are localised in the other one."""
    iterations: Count = 0  # descent hardly ever finds what alignment does not, and takes half of a search
    """Maximum number of Adam steps per keyframe, after alignment; each step is a render. 0 = only alignment."""
    method: Literal["keyframe", "few-steps", "paper", "paper-fine", "rendered"] = "keyframe"
    """How a keyframe is localised in the other submap. keyframe: against the map, and finally against the recorded
    image of the nearest keyframe there (ours), because the surfaces of a young map are biased; a loop that only the
    maps show is rejected. The others use the pose relative to the map (paper): few-steps = with small Adam steps;
    paper, paper-fine = with those of VarSplat for real images and for Replica; rendered = as paper, with the image that
    its own submap renders instead of the recorded one (VarSplat's code for ScanNet)."""
    exposure: ClassVar[bool] = True
    """Whether a factor and an offset of the colour are fitted too, because submaps may differ in exposure."""
    weight_color: ClassVar[float] = 0.95
    """λ_c, the weight of the colour loss in registration; the depth loss has 1 − λ_c."""
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

    lr_rotation = FromRow[float]("method", REGISTRATIONS)
    lr_translation = FromRow[float]("method", REGISTRATIONS)
    color_mean = FromRow[str]("method", REGISTRATIONS)
    target = FromRow[str]("method", REGISTRATIONS)

    @property
    def to_keyframe(self) -> bool:
        """Whether a localised keyframe is finally aligned to the recorded image of the nearest keyframe."""
        return self.method == "keyframe"


class Schedule(NamedTuple):
    """What belongs to a way of refining the final map. The values that a row leaves out are the paper's."""

    order: str = "random"
    """Order of the keyframes: drawn for each step (random), or each once before any is used again (epochs)."""
    exposure: bool = False
    """Whether the exposure of each keyframe relative to the map is fitted: a gain and an offset for each channel."""
    sh_every: int = 1000
    """Number of steps after which the degree of view-dependent colour rises by one."""
    merge_m: float = 0.02
    """Edge in metres of the voxels in which merging keeps the splats of one submap, times the scale of the scene."""
    lr_means_last: float = 0.0
    """Learning rate of positions in the last step, metres, times the scale of the scene; it decays exponentially from
    `mapping.lr_means` (3DGS). 0 = `mapping.lr_means` throughout."""
    lr_factor: float = 1.0
    """Factor on the learning rates of mapping (`mapping.lr_…`) in the first step, except that of positions."""
    lr_log_scales: float = 0.0
    """Learning rate of sizes in the first step. 0 = `lr_factor` times `mapping.lr_log_scales`."""
    lr_decay: float = 1.0
    """Rates of splats and poses in the last step, as a share of those in the first; they decay exponentially."""
    beta2: float = 0.999
    """Decay β₂ of Adam's second moment."""
    prune_weight_px: float = 0.0
    """Before and after, splats are removed if their weights in every keyframe sum to less than this, in pixels."""
    weight_moment: bool = True
    """Whether the depth uncertainty U stays in the loss (`mapping.weight_moment`)."""
    max_axis_ratio: float = 0.0
    """Largest ratio of a splat's longest axis to its shortest; refinement lengthens shorter axes. 0 = no limit."""
    max_needle_ratio: float = 0.0
    """Largest ratio of a splat's longest axis to its second longest; refinement shortens the longest. 0 = no limit."""


SCHEDULES = {
    "steady": Schedule(),
    "falling": Schedule(lr_means_last=1.6e-6),
    "epochs": Schedule(
        order="epochs", exposure=True, sh_every=100,
        merge_m=0.05,  # 40 % fewer splats than with 0.02, and no seams between neighbouring voxels
        lr_factor=12.0,  # the rates of mapping are too small for 1000 steps: shapes hardly change
        lr_log_scales=0.08,  # with half of it, views are up to 0.2 dB less sharp
        lr_decay=0.05,
        # The size of a step follows the last hundred gradients: each keyframe has about a dozen steps, and 0.999
        # remembers gradients of the merged map.
        beta2=0.99,
        prune_weight_px=0.5,
        weight_moment=False,  # it does not improve a map of few steps, and costs an eighth of the time
        max_axis_ratio=19.0, max_needle_ratio=8.0,
    ),
}  # fmt: skip
"""The values that belong to each `final.schedule`: of the paper, its code, and ours."""


@dataclass(frozen=True)
class FinalConfig(Section, name="final"):
    """The global map, made from all submaps after the last frame (VarSplat §7)."""

    seed_from: Literal["submaps", "mesh"] = "submaps"
    """Initial splats of the final map: submaps = the splats of the submaps; mesh = new splats on the fused surface
    (paper)."""
    iterations: Count = 1000
    """Number of refinement steps over all keyframes; 0 = no refinement."""
    move_poses: bool = True
    """Whether keyframes, and with them frames, move at the end (ours); off = the path stays the tracked one (paper).
    First the graph of keyframes moves them (`loops`), then refinement: by about half the median standard deviation of
    their positions at most, from 1 mm to 1 cm."""
    seconds: NotNegative = 0.0
    """Time budget of the refinement in seconds: it ends at the latest then, even if steps are left, and learning rates
    fall in time. The result then depends on the speed of the machine. 0 = no limit."""
    schedule: Literal["steady", "falling", "epochs"] = "epochs"
    """How refinement runs. steady: keyframes drawn for each of many steps at the rates of mapping (paper); falling: the
    same with a rate of positions that falls to 1.6e-6 m (VarSplat's code); epochs: every keyframe once, in random
    order, before any is used again, for few steps at rates that fall, without U, without hidden splats, with limits on
    the shapes of splats, with the exposure of each keyframe, a gain and an offset for each channel, fitted too, and
    from a map that keeps the splats of one submap in voxels of 5 cm instead of 2 cm (ours)."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Degree of view-dependent colour reached during refinement, 0 to 3."""
    spacing_m: ClassVar[float] = 0.02
    """Distance between the splats seeded on the mesh, in metres, times the scale of the scene."""
    prune_every: ClassVar[int] = 500
    """Number of refinement steps between removals of splats with low opacity (`prune_opacity`)."""
    prune_opacity: ClassVar[float] = 0.005
    """Splats with at most this opacity, 0 to 1, are removed during refinement."""
    width: Annotated[int, WIDTHS_PX] = 0
    """Width of the images in the last stage of refinement in pixels, at most the recorded width, so that 8192 is the
    camera's; 0 = no such stage, only working images are used. If it is above `input.width`, the colour of each keyframe
    is kept at this size."""
    width_iterations: Count = 8000
    """Number of refinement steps of the stage with images of `width`, after those of `iterations`, if `iterations` is
    above 0. Two thirds of them use working images, so that the map stays sharp at that size too."""
    uncertainty: bool = True
    """Whether variance is used to merge submaps and still learned during refinement; off = paper."""

    @property
    def lr_pose_translation(self) -> float:
        """Learning rate of keyframe positions, metres, times the scale of the scene; 0 = fixed."""
        return 0.0003 if self.move_poses else 0.0

    @property
    def lr_pose_rotation(self) -> float:
        """Learning rate of keyframe rotations, rad; 0 = fixed."""
        return 0.0002 if self.move_poses else 0.0

    @property
    def pose_reach_m(self) -> float:
        """About how far refinement can move a keyframe from its tracked pose, in metres, times the scale of the scene:
        each step takes back the share `lr_pose_translation` / `pose_reach_m` of this motion and turn. Without a limit,
        refinement bends a path that tracking found to a millimetre. `final_map.reaching` raises it."""
        return 0.001 if self.move_poses else 0.0

    @property
    def pose_reach_most_m(self) -> float:
        """The largest reach, in metres, times the scale of the scene. Where tracking is less sure, views are 0.2 to
        0.3 dB sharper with it."""
        return 0.01 if self.move_poses else 0.0

    order = FromRow[str]("schedule", SCHEDULES)
    exposure = FromRow[bool]("schedule", SCHEDULES)
    sh_every = FromRow[int]("schedule", SCHEDULES)
    merge_m = FromRow[float]("schedule", SCHEDULES)
    lr_means_last = FromRow[float]("schedule", SCHEDULES)
    lr_factor = FromRow[float]("schedule", SCHEDULES)
    lr_log_scales = FromRow[float]("schedule", SCHEDULES)
    lr_decay = FromRow[float]("schedule", SCHEDULES)
    beta2 = FromRow[float]("schedule", SCHEDULES)
    prune_weight_px = FromRow[float]("schedule", SCHEDULES)
    weight_moment = FromRow[bool]("schedule", SCHEDULES)
    max_axis_ratio = FromRow[float]("schedule", SCHEDULES)
    max_needle_ratio = FromRow[float]("schedule", SCHEDULES)


@dataclass(frozen=True)
class SurfaceConfig(Section, name="surface"):
    """The mesh of a finished run. Raises ConfigError on invalid values."""

    depth: Literal["map", "map+sensor"] = "map+sensor"
    """Depth that is fused at each keyframe: map = rendered from its submap (VarSplat §7); map+sensor = rendered from
    the final map, and the readings of the keyframe, weighted by their variances (ours)."""


@dataclass(frozen=True)
class UncertaintyConfig(Section, name="uncertainty"):
    """Calibration of the variance that a map predicts for its colour and depth (ours). Raises ConfigError on invalid
    values."""

    probes: Count = 4
    """Number of probe views that each submap keeps: well-tracked frames that are not keyframes. The map is not fitted
    to them; the predicted variance is calibrated on them after the last frame. 0 = no predicted variance."""
