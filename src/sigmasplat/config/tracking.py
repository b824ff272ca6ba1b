"""Settings of tracking: method, iterations, weights; recovery of a lost camera, moving things, the real-time clock."""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

from sigmasplat.config.ranges import Above0, Count, FromRow, NotNegative, Section, Share


class DescentRow(NamedTuple):
    """What belongs to a descent."""

    parametrisation: str
    """What Adam optimises: a quaternion and a translation relative to the guess, or axis-angle and position."""
    average: str
    """Whether errors are averaged over all pixels (image), or over those that each of colour and depth uses (kept)."""
    amsgrad: bool = False
    """Whether Adam divides by the largest second moment so far (AMSGrad)."""
    first_iterations: int = 0
    """Number of steps for the second frame; 0 = as for other frames."""


DESCENTS = {
    "quaternion": DescentRow("quaternion", "image"),
    "amsgrad": DescentRow("quaternion", "image", amsgrad=True),
    "axis-angle": DescentRow("axis-angle", "kept"),
    "axis-angle-start": DescentRow("axis-angle", "kept", first_iterations=200),
}
"""The values that belong to each `tracking.descent`: the first two are of VarSplat and of its code, the others of
CG-SLAM and of its code."""


@dataclass(frozen=True)
class TrackingConfig(Section, name="tracking"):
    """Fit of camera poses: method, iterations, masks, weights (VarSplat §3; CG-SLAM §6)."""

    method: Literal["adam", "align"] = "align"  # Gauss–Newton on images instead of 200 renders per frame
    """adam: gradient descent through the renderer, as in the papers; align: Gauss–Newton on the image of the newest
    keyframe."""
    iterations: Count = 200
    """Maximum number of Adam steps per frame. Use more for fast or shaky motion, fewer for speed."""
    align_depth_by: Literal["V", "U"] = "V"
    """Whether alignment weights depth residuals by V, like gray residuals, or in the same way by the depth variance U
    of the map (CG-SLAM eq. 10)."""
    align_weight_color: Share = 0.1  # gray has the smaller basin of convergence; with 0.5, steps of 5° fail
    """Weight of gray residuals in alignment; depth residuals have 1 minus this."""
    descent: Literal["quaternion", "amsgrad", "axis-angle", "axis-angle-start"] = "quaternion"
    """What `method` adam descends over. quaternion: a quaternion and a translation relative to the initial guess, with
    errors averaged over all pixels; amsgrad: the same with AMSGrad; axis-angle: the axis-angle rotation and the
    position of the camera, with errors averaged over the pixels that each of colour and depth uses, colour only below
    10 times its median error; axis-angle-start: the same with 200 steps for the second frame, which has no motion
    model yet, and a rotation of 3e-3 rad per step there."""
    lr_rotation: NotNegative = 2e-3
    """Learning rate of rotation, radians per step; with quaternions the angle per step is twice as large. Use a higher
    one for fast motion."""
    lr_translation: NotNegative = 1e-2
    """Learning rate of translation, metres per step."""
    weight_color: Share = 0.6
    """λ_c, the weight of the colour loss; the depth loss has 1 − λ_c."""
    uncertainty: bool = False  # alignment to recorded images gains nothing by it
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
    restart: Literal["off", "longer", "odometry"] = "off"
    """What `method` adam does if the loss at the first guess is above a multiple of the median loss at which recent
    frames ended: longer = above 5, twice the iterations (VarSplat's code); odometry = above 50, the same from the
    motion that aligning the last image gives (VarSplat on ScanNet++)."""
    exposure: bool = False
    """Whether a factor and an offset of the colour are fitted with the pose, for cameras that change their exposure."""
    lr_exposure: ClassVar[float] = 0.01
    """Learning rate of the exposure: change per step of the factor's logarithm and of the offset (colours 0 to 1)."""
    features: bool = True
    """Whether sparse features give a second guess of the pose where the first fit is doubtful (ours); the pose that is
    least likely wrong is used."""
    verify: bool = True
    """Whether a pose is judged by comparing surfaces at it (ours); off = by agreement and overlap only. It needs
    `method` align, which then uses the part of σ that depends on the distance, by the model of `input.sensor`, instead
    of `render.depth_noise_per_m`, also for loops and lost cameras."""
    fit_depth: bool = False
    """Whether the depth of each frame is fitted to the map and to other views before it is used, because its scale is
    arbitrary. `run` sets it for depth that a network predicted."""
    plateau_stop: ClassVar[float] = 0.0
    """Adam stops when `plateau_window` steps have not lowered the loss by this share, and a level of
    alignment when one step changes the loss by less; 0 = off. Registration has a limit (`graph.registration`)."""
    plateau_window: ClassVar[int] = 10
    """Number of Adam steps within which the loss must fall by the share `plateau_stop`."""
    cuda_graphs: ClassVar[bool] = True
    """On a CUDA device, whether several iterations of descent are launched as one CUDA graph; off = each kernel is
    launched on its own."""

    parametrisation = FromRow[str]("descent", DESCENTS)
    average = FromRow[str]("descent", DESCENTS)
    amsgrad = FromRow[bool]("descent", DESCENTS)
    first_iterations = FromRow[int]("descent", DESCENTS)

    @property
    def lost_agreement(self) -> float:
        """Tracking is lost if map and sensor agree in depth on less than this share of the pixels where both have a
        surface; not used with `verify`. With `method` adam no frame is lost (papers)."""
        return 0.0 if self.method == "adam" else 0.6

    @property
    def lost_share(self) -> float:
        """Tracking is lost if the map agrees with less than this share of the sensor's readings (agreement × overlap);
        with `verify`, if reference and frame have less than this share of the reference's readings in common. With
        `method` adam no frame is lost (papers)."""
        return 0.0 if self.method == "adam" else 0.2

    def without_motion(self) -> "TrackingConfig":
        """Return the settings for the second frame of a sequence, which has no motion model yet (CG-SLAM's code)."""
        if not self.first_iterations:
            return self
        return replace(self, iterations=self.first_iterations, lr_rotation=self.first_lr_rotation)

    @property
    def outlier_factor_color(self) -> float:
        """Colour counts only where its error, summed over channels, is below this multiple of its median; 0 = off."""
        return 10.0 if self.average == "kept" else 0.0

    @property
    def first_lr_rotation(self) -> float:
        """Learning rate of rotation for the second frame; 0 = as for other frames."""
        return 3e-3 if self.first_iterations else 0.0


@dataclass(frozen=True)
class RecoveryConfig(Section, name="recovery"):
    """Relocalisation of a lost camera, and new maps if it is not found (ours)."""

    relocalise: bool = True
    """Whether a lost camera is searched for in the keyframes of all submaps, by features; off = only near the last
    pose, every tracked frame may be mapped, and no new map begins (papers)."""
    candidates: ClassVar[int] = 8
    """Number of keyframes, those with the most matches, from which the pose of a lost camera is computed and
    verified."""

    @property
    def steady_frames(self) -> int:
        """After the camera was lost, nothing is mapped until this many frames in a row have been tracked without doubt;
        0 = off (papers)."""
        return 2 if self.relocalise else 0

    @property
    def new_map_after(self) -> int:
        """A new map begins after this many lost frames in a row; frames without depth or with a flat image do not
        count. It joins the old map when a place is recognised; 0 = never."""
        return 20 if self.relocalise else 0


@dataclass(frozen=True)
class MovingConfig(Section, name="moving"):
    """Things that move are left out of tracking and of the map (ours)."""

    find: bool = True  # what it costs where nothing moves: benchmarks/search_cost.py
    """Whether keyframes are compared with each other: what one shows in space that another has seen to be free is
    masked, and splats there are removed. Off = with `tracking.verify` only what comes in front of the newest keyframe
    is masked, else nothing (papers)."""
    still_frames: ClassVar[int] = 30
    """What was found to move and then stays in place for this many frames becomes part of the map again; 0 = never."""
    compared: ClassVar[int] = 3
    """Number of earlier keyframes of the submap that a new keyframe is compared with."""
    carve_votes: ClassVar[int] = 3
    """A splat is removed if this many keyframes see through its place and none shows a surface there."""


@dataclass(frozen=True)
class RealTimeConfig(Section, name="realtime"):
    """Live cameras and `run --realtime`: when frames become keyframes, and how much mapping may wait. Raises
    ConfigError on invalid values."""

    live: bool = True
    """Whether live cameras run in real time; off = a frame waits until the one before it is mapped."""
    keyframe_deg: ClassVar[float] = 5.0
    """A frame becomes a keyframe when the image has moved by this angle since the last keyframe: rotation plus
    translation divided by the mean depth. There are not more keyframes than in a recording (`mapping.every`), because
    each adds an error to the path, unless the overlap is low. 0 = by the number of frames, as in a recording."""
    waiting_most: ClassVar[int] = 24
    """Maximum number of keyframes that wait for mapping; while as many wait, no frame becomes a keyframe."""
    spare_iterations: ClassVar[int] = 60
    """Maximum number of additional iterations after a keyframe is mapped, while no other keyframe waits; 0 = none."""
