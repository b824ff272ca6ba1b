"""RGB-D SLAM on 3D Gaussian splats, with uncertainty.

from sigmasplat import Slam, open_source

slam = Slam()
for frame in open_source("path/to/sequence"):
    step = slam.step(frame)
slam.finish()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sigmasplat import env as env  # must come before torch: it sets how idle OpenMP threads wait

if TYPE_CHECKING:
    from sigmasplat.config import Config as Config
    from sigmasplat.config.find_preset import preset as preset
    from sigmasplat.data.camera import Camera as Camera
    from sigmasplat.data.field import GaussianField as GaussianField
    from sigmasplat.data.frame import Frame as Frame
    from sigmasplat.errors import SigmaSplatError as SigmaSplatError
    from sigmasplat.plugins.sources import open_source as open_source
    from sigmasplat.realtime.system import RealTime as RealTime
    from sigmasplat.run.scene import open_scene as open_scene
    from sigmasplat.system.slam import Slam as Slam

# Imported at first use, so that `import sigmasplat` and `sigmasplat --help` do not load torch. The function `render` is
# not here, because `sigmasplat.render` is its package: use `from sigmasplat.render import render`.
_HOMES = {
    "Camera": "sigmasplat.data.camera",
    "Config": "sigmasplat.config",
    "Frame": "sigmasplat.data.frame",
    "GaussianField": "sigmasplat.data.field",
    "RealTime": "sigmasplat.realtime.system",
    "SigmaSplatError": "sigmasplat.errors",
    "Slam": "sigmasplat.system.slam",
    "open_scene": "sigmasplat.run.scene",
    "open_source": "sigmasplat.plugins.sources",
    "preset": "sigmasplat.config.find_preset",
}
__all__ = [*sorted(_HOMES), "__version__"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _HOMES:
        raise AttributeError(f"module 'sigmasplat' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("sigmasplat")
    except metadata.PackageNotFoundError:  # a checkout on PYTHONPATH, not installed
        return "unknown"
