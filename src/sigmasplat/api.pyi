from sigmasplat.config import Config as Config, InputConfig as InputConfig, RenderConfig as RenderConfig
from sigmasplat.config.find_preset import preset as preset
from sigmasplat.data import se3 as se3
from sigmasplat.data.camera import Camera as Camera
from sigmasplat.data.field import GaussianField as GaussianField
from sigmasplat.data.frame import Frame as Frame
from sigmasplat.data.frame_arrays import frame_from_arrays as frame_from_arrays
from sigmasplat.data.trajectory import Trajectory as Trajectory
from sigmasplat.errors import (
    ConfigError as ConfigError,
    RunError as RunError,
    SigmaSplatError as SigmaSplatError,
    SourceError as SourceError,
)
from sigmasplat.fit.backends import fits_of as fits_of
from sigmasplat.input.opening import open_source as open_source
from sigmasplat.input.source import Source as Source
from sigmasplat.registry import (
    Backend as Backend,
    DepthFilter as DepthFilter,
    Mask as Mask,
    Output as Output,
    Preset as Preset,
    SourceFormat as SourceFormat,
)
from sigmasplat.render.backend import make_view as make_view
