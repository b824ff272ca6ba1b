"""Settings of the work per submap: when to start a new one, loops, registration."""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

from sigmasplat.config.ranges import Above0, AtLeastOne, Count, FromRow, NotNegative, Section, Share


@dataclass(frozen=True)
class SubmapConfig(Section, name="submaps"):
    """Rules that end the active submap and start the next one; checked at each keyframe (VarSplat §2)."""

    distance_m: NotNegative = 0.5
    """A new submap starts if the camera is farther than this from the submap's first pose, or has rotated by more than
    50°; 0 = off. If all rules are off, the map is one submap."""
    frames: Count = 0
    """A new submap starts this many frames after the first one of the active submap; 0 = off."""
    uncertainty_m: NotNegative = 0.02
    """A new submap starts if the standard deviation of the camera's position in the submap, accumulated from keyframe
    to keyframe, exceeds this; 0 = off."""
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
    weight_color: float = 0.95
    """λ_c, the weight of the colour loss in registration; the depth loss has 1 − λ_c."""
    textured: bool = False
    """Whether colour counts only at pixels with much more gradient than others near them (`fit.target.textured`)."""
    plain_gate: bool = False
    """Whether loops are gated by plain r(q) · r(d), without limits of weights and gate (VarSplat eq. 18)."""
    judges: bool = False
    """Whether localisations must agree with the sensor and with each other (ours); off = all are combined (papers)."""


REGISTRATIONS = {
    "keyframe": RegistrationRow(0.001, 0.001, "pixels", judges=True),
    "few-steps": RegistrationRow(0.001, 0.001, "pixels", judges=True),
    "paper": RegistrationRow(0.015, 0.005, "values", weight_color=0.5, plain_gate=True),
    "paper-fine": RegistrationRow(0.003, 0.001, "values", weight_color=0.5, plain_gate=True),
    "code": RegistrationRow(0.015, 0.005, "values", textured=True),
    "code-fine": RegistrationRow(0.003, 0.001, "values", textured=True),
    "rendered": RegistrationRow(0.015, 0.005, "values", "rendered", textured=True),
}
"""The values that belong to each `registration.method`: of the paper, its code, or ours."""


@dataclass(frozen=True)
class RegistrationConfig(Section, name="registration"):
    """Registration of two submaps, and acceptance of the result (VarSplat §5)."""

    keyframes: ClassVar[int] = 2
    """Number of keyframes of each submap that are localised in the other one."""
    iterations: Count = 0  # descent hardly ever finds what alignment does not, and takes half of a search
    """Maximum number of Adam steps per keyframe, after alignment; each step is a render. 0 = only alignment."""
    method: Literal["keyframe", "few-steps", "paper", "paper-fine", "code", "code-fine", "rendered"] = "keyframe"
    """How a keyframe is localised in the other submap. keyframe: against the map, and finally against the recorded
    image of the nearest keyframe there (ours), because the surfaces of a young map are biased; a loop that only the
    maps show is rejected. The others are against the map alone: few-steps = with small Adam steps; paper, paper-fine =
    by the loss and the gate of VarSplat's text (eq. 18, 19), with its steps for real images and for Replica; code,
    code-fine = as VarSplat's code: λ_c 0.95, colour only at pixels with much gradient, a gate with limits; rendered =
    as code, with the image that its own submap renders (VarSplat's code for ScanNet)."""
    exposure: ClassVar[bool] = True
    """Whether a factor and an offset of the colour are fitted too, because submaps may differ in exposure."""
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
    weight_color = FromRow[float]("method", REGISTRATIONS)
    textured = FromRow[bool]("method", REGISTRATIONS)
    plain_gate = FromRow[bool]("method", REGISTRATIONS)
    judges = FromRow[bool]("method", REGISTRATIONS)

    @property
    def to_keyframe(self) -> bool:
        """Whether a localised keyframe is finally aligned to the recorded image of the nearest keyframe."""
        return self.method == "keyframe"
