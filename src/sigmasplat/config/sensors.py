"""How sure the depth readings of a sensor are: models as numbers, shipped ones by name, others from text."""

from dataclasses import dataclass, fields
from typing import Annotated

from sigmasplat.config.ranges import Above0, NotNegative, Range, Section, refuse
from sigmasplat.errors import ConfigError


@dataclass(frozen=True)
class SensorModel(Section, name="sensor"):
    """Standard deviation of a depth reading z (m): σ = √(base² + (z1·z)² + (z2·z²)²) · edge^e · (1/cos θ)^grazing, at
    most `most`·z; e = 1 beside a depth step, else 0; θ: the angle between ray and normal. `shared` is not part of σ.
    Raises ConfigError on invalid values."""

    base: NotNegative = 0.0
    """Constant part, metres."""
    z1: NotNegative = 0.0
    """Part that grows with z, no unit: time of flight and LiDAR."""
    z2: NotNegative = 0.0
    """Part that grows with z², per metre: triangulation."""
    edge: Annotated[float, Range(1)] = 1.0
    """Factor beside a depth step, where a reading may belong to either surface."""
    grazing: Annotated[float, Range(0, 4)] = 0.0
    """Power of 1 / cos θ; 0 = σ does not depend on the angle."""
    most: Above0 = 1.0
    """Largest σ as a share of z."""
    shared: NotNegative = 0.0
    """Error that neighbouring readings have in common, such as that of the calibration, times z², per metre. Alignment
    averages over neighbours, which does not reduce this error."""

    def problems(self) -> list[str]:
        """Describe each invalid value, and a σ that is 0 everywhere."""
        found = super().problems()
        if not found and not (self.base or self.z1 or self.z2):
            found.append("sensor needs base, z1 or z2 above 0; without them every reading would be exact")
        return found

    def __str__(self) -> str:
        """Return the text that `sensor_model` reads."""
        changed = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return ",".join(f"{name}:{value:.6g}" for name, value in changed.items())


SENSORS = {
    # Khoshelham & Elberink 2012: σ = 1.4e-3 z². Nguyen et al. 2012: 1.2 mm + 1.9 mm/m² (z − 0.4 m)², which base and z2
    # meet within 8 % from 0.6 to 4 m; about one pixel of lateral error at edges; more noise at grazing angles. `shared`
    # is ours: with noise alone, the path of redkitchen is 2 % worse than with 3e-3 z² in all, the generic law.
    "kinect-v1": SensorModel(base=0.0012, z2=0.0015, edge=3.0, grazing=1.0, shared=0.0025),
    # Grunnet-Jepsen et al. 2018 (tuning of D400): σ = z² · subpixel error / (f · baseline), with 0.08 px, 424 px (848
    # pixels wide), 50 mm.
    "realsense-stereo": SensorModel(base=0.001, z2=0.0038, edge=3.0, grazing=1.0),
    # Luetzenburg et al. 2021: 1 cm on objects of a room, hardly dependent on z; depth images are interpolated between
    # few measured points, so edges are wide.
    "lidar-iphone": SensorModel(base=0.005, z1=0.005, edge=4.0, grazing=1.0),
    # Fankhauser et al. 2015 (Kinect v2): 1.5 − 0.5 z + 0.3 z² mm, and more at grazing angles; Tölgyessy et al. 2021
    # (Azure Kinect) and Hübner et al. 2020 (HoloLens) find a similar growth. Readings at edges lie between surfaces.
    "time-of-flight": SensorModel(base=0.0012, z1=0.0005, z2=0.00025, edge=4.0, grazing=1.0),
}
"""Models of σ by sensor. The factors at edges are ours: papers give lateral errors in pixels."""
GENERIC = "generic"
"""The law of `render.depth_noise_per_m`, σ = noise · z², for sensors that are not known."""
AUTO = "auto"


def sensor_model(text: str) -> SensorModel | None:
    """Return the model that `input.sensor` names, or that it spells as in `base:0.001,z2:0.0015`; None for the generic
    law. Raises ConfigError if it is neither."""
    if text in (AUTO, GENERIC):
        return None
    return SENSORS[text] if text in SENSORS else SensorModel(**dict(map(_part, text.split(","))))


def sensor_problems(text: str) -> list[str]:
    """Describe what is wrong with a value of `input.sensor`."""
    try:
        sensor_model(text)
    except ConfigError as problem:
        return [f"input.sensor: {problem}"]
    return []


def _part(text: str) -> tuple[str, float]:
    """Return name and value of a part of a spelled model."""
    name, colon, value = text.partition(":")
    known = [f.name for f in fields(SensorModel)]
    if not colon or name.strip() not in known:
        refuse([
            f"{text!r} is neither a sensor ({', '.join([AUTO, GENERIC, *SENSORS])}) nor a part of a model such as "
            f"z2:0.003 (parts: {', '.join(known)})"
        ])  # fmt: skip
    try:
        return name.strip(), float(value)
    except ValueError:
        raise ConfigError(f"{text!r} has no number after the colon; write for example z2:0.003") from None
