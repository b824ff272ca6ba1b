"""The compiled kernels: `_core`, built from the sources in this folder. It takes arrays and does not link torch.

Importing this package raises BackendError if they cannot be loaded.
"""

from sigmasplat.errors import BackendError

try:
    import sigmasplat.native._core  # noqa: F401 # others import it
except ImportError as problem:
    raise BackendError(
        f"the compiled kernels cannot be loaded ({problem}); reinstall with `pip install .`"
    ) from problem
