"""Settings of what is done submap by submap: cutting, loops, registration, the final map."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class SubmapConfig:
    """When the active submap is finished and the next one begun: asked at each keyframe (VarSplat §2)."""

    distance_m: float = 0.0
    """Farther than this from the submap's first pose; 0 = off, as below. With all four off the map is one submap."""
    angle_deg: float = 0.0
    """… or turned by more than this from it."""
    frames: int = 0
    """… or so many frames after it."""
    uncertainty_m: float = 0.0
    """… or tracking has lost so much of its hold: standard deviation of the camera's position in the submap, summed up
    from keyframe to keyframe (`slam.drift`)."""
    inherit: bool = False
    """Begin the next submap with copies of the splats in view, and map them like any; off = from nothing (paper)."""


@dataclass(frozen=True)
class LoopConfig:
    """Which submaps may show one place (VarSplat §4)."""

    close: bool = True
    """Whether loops are looked for at all."""
    descriptor: Literal["grid", "netvlad"] = "grid"
    """grid: built in (`slam.descriptors.OrientationGrid`); netvlad: from the file `weights`."""
    weights: str = ""
    """The file of NetVLAD's weights that descriptor=netvlad needs; read at the start."""
    min_similarity: float = 0.5
    """A submap's own views are this share alike: which of their similarities is the threshold."""
    min_interval: int = 2
    """Submaps nearer than this in the sequence are neighbours, not loops."""
    similarity_floor: float = 0.0
    """No pair less alike than this is tried, however unlike a submap's own views are."""
    near_m: float = 0.0
    """Keyframes nearer than this by the poses known so far are tried too, however they look; 0 = off (paper)."""
    near_deg: float = 30.0
    """… and turned by less than this."""
    most: int = 4
    """At most so many pairs are registered per finished submap, the most alike first; 0 = no limit."""
    uncertainty: bool = True
    """Gate similarity by the variance-weighted opacity ratio; off = LoopSplat."""
    tau: float = 10.0
    """τ of the weights of that ratio's splats by their σ²; smaller tells sure splats from doubtful ones more
    sharply."""
    weight_max: float = 3.0
    """… and their bounds: no splat counts more than this many times, or less than 1 / this."""


@dataclass(frozen=True)
class RegistrationConfig:
    """How two submaps are laid onto each other, and when that is believed (VarSplat §5)."""

    keyframes: int = 2
    """Of each submap so many keyframes are localised in the other one."""
    iterations: int = 100
    """Adam's steps per keyframe at most, after it has been aligned; each is a render."""
    lr_rotation: float = 1.5e-2
    """Rate of rotation in those steps, as `tracking.lr_rotation`."""
    lr_translation: float = 5e-3
    """Rate of translation in them, metres per step."""
    plateau_stop: float = 1e-4
    """They end when a step changes the loss by less than this share of it; 0 = when they are all done."""
    exposure: bool = True
    """Whether a factor and an offset of the colour are fitted too: submaps may be of differently exposed images."""
    weight_color: float = 0.95
    """λ_c of their loss; depth has 1 − λ_c."""
    uncertainty: bool = True
    """Weigh pixels by the other submap's V; off = LoopSplat."""
    tau: float = 50.0
    """τ of those weights, as `tracking.tau`."""
    weight_max: float = 3.0
    """… and their bounds: no pixel counts more than this many times, or less than 1 / this."""
    overlap_least: float = 0.2
    """Refused where fewer of the splats than this have a neighbour within `overlap_m` in the other submap."""
    overlap_m: float = 0.1
    """How near a neighbour is that counts, metres; about what two maps of one wall may lie apart."""
    agreement_least: float = 0.8
    """A localisation counts if this share of the surfaces in common agrees in depth …"""
    share_least: float = 0.3
    """… and the other submap explains this share of the readings."""
    spread_m: float = 0.1
    """Refused unless two localisations that count, at least, lie within this of one of them, metres …"""
    spread_deg: float = 5.0
    """… and are turned by no more than this against it."""


@dataclass(frozen=True)
class FinalConfig:
    """The global map, made of all submaps once the frames have ended (VarSplat §7)."""

    seed_from: Literal["submaps", "mesh"] = "submaps"
    """submaps: their splats as they are; mesh: new ones on the fused surface (paper)."""
    iterations: int = 0
    """Steps of refinement over all keyframes; 0 = none."""
    sh_degree: int = 0
    """Degree of view-dependent colour reached in refinement, 0 to 3."""
    sh_every: int = 1000
    """One degree more each so many steps."""
    spacing_m: float = 0.02
    """Distance of splats seeded on the mesh."""
    prune_every: int = 500
    """Each so many steps splats that have faded go."""
    prune_opacity: float = 0.005
    """Those no more opaque than this, 0 to 1."""
    uncertainty: bool = True
    """Merge by variance, keep σ² and its likelihood in refinement; off = paper."""
