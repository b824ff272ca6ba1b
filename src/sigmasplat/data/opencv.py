"""Import OpenCV when it is first needed."""

import functools
import importlib
from typing import Any

from sigmasplat.env import install_package, switches
from sigmasplat.errors import ConfigError


@functools.cache
def opencv() -> Any:
    """Return the module cv2; it uses SIGMASPLAT_THREADS threads. Raises ConfigError if it cannot be imported."""
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError as problem:
        raise ConfigError(
            f"features and stereo pairs need OpenCV, which does not load ({problem}): "
            f"{install_package('opencv-python-headless')}"
        ) from problem
    if switches().threads:
        cv2.setNumThreads(switches().threads)
    return cv2
