"""Settings of the final map, of its surface and of its uncertainty."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

from sigmasplat.config.ranges import WIDTHS_PX, Count, FromRow, NotNegative, Range, Section


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
    First their graph moves them, then refinement, by about half the median standard deviation of their positions at
    most, 1 mm to 1 cm."""
    seconds: NotNegative = 0.0
    """Time budget of the refinement in seconds: it ends at the latest then, even if steps are left, and learning rates
    fall in time. The result then depends on the speed of the machine. 0 = no limit."""
    schedule: Literal["steady", "falling", "epochs"] = "epochs"
    """How refinement runs. steady: keyframes drawn for each of many steps at the rates of mapping (paper); falling: the
    same with a rate of positions that falls to 1.6e-6 m (VarSplat's code); epochs (ours, docs/final-map.md): every
    keyframe once, in random order, before any is used again; few steps at rates that fall, without U and without hidden
    splats; limits on the shapes of splats; a fitted exposure for each keyframe; merging in voxels of 5 cm instead of
    2 cm."""
    sh_degree: Annotated[int, Range(0, 3)] = 3
    """Degree of view-dependent colour reached during refinement, 0 to 3."""
    spacing_m: ClassVar[float] = 0.02
    """Distance between the splats seeded on the mesh, in metres, times the scale of the scene."""
    prune_every: ClassVar[int] = 500
    """Number of refinement steps between removals of splats with low opacity (`prune_opacity`)."""
    prune_opacity: ClassVar[float] = 0.005
    """Splats with at most this opacity, 0 to 1, are removed during refinement."""
    width: Annotated[int, WIDTHS_PX] = 640  # a phone's photo has ten times as many pixels, and costs ten times as much
    """Width of the images in the last stage of refinement in pixels, at most the recorded width, so that 8192 is the
    camera's; 0 = no such stage (papers). If it is above `input.width`, the colour of each keyframe is kept at this
    size, and `iterations` more steps follow; with a time budget they go on until it ends. Two thirds of them use
    working images, so that the map stays sharp at that size too."""
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
