"""How sure the depth readings of a sensor are: models as numbers, by name."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SensorModel:
    """Standard deviation of a depth reading z (m): σ = √(base² + (z1·z)² + (z2·z²)²); `shared` is not part of σ."""

    base: float = 0.0
    """Constant part, metres."""
    z1: float = 0.0
    """Part that grows with z, no unit: time of flight and LiDAR."""
    z2: float = 0.0
    """Part that grows with z², per metre: triangulation."""
    shared: float = 0.0
    """Error that neighbouring readings have in common, such as that of the calibration, times z², per metre. Alignment
    averages over neighbours, which does not reduce this error."""


SENSORS = {
    # Khoshelham & Elberink 2012: σ = 1.4e-3 z². Nguyen et al. 2012: 1.2 mm + 1.9 mm/m² (z − 0.4 m)², which base and z2
    # meet within 8 % from 0.6 to 4 m. `shared` is ours: with noise alone, the path of redkitchen is 2 % worse than with
    # 3e-3 z² in all, the generic law.
    "kinect-v1": SensorModel(base=0.0012, z2=0.0015, shared=0.0025),
    # Grunnet-Jepsen et al. 2018 (tuning of D400): σ = z² · subpixel error / (f · baseline), with 0.08 px, 424 px (848
    # pixels wide), 50 mm.
    "realsense-stereo": SensorModel(base=0.001, z2=0.0038),
    # Luetzenburg et al. 2021: 1 cm on objects of a room, hardly dependent on z.
    "lidar-iphone": SensorModel(base=0.005, z1=0.005),
    # Fankhauser et al. 2015 (Kinect v2): 1.5 − 0.5 z + 0.3 z² mm; Tölgyessy et al. 2021 (Azure Kinect) and Hübner et
    # al. 2020 (HoloLens) find a similar growth.
    "time-of-flight": SensorModel(base=0.0012, z1=0.0005, z2=0.00025),
}
"""Models of σ by sensor."""


RENDERED = "rendered"
"""Images of a renderer: their calibration and their times are exact; readings follow the generic law."""


def sensor_model(name: str) -> SensorModel | None:
    """Return the model of a sensor that `input.sensor` names; None for the generic law."""
    return SENSORS.get(name)
