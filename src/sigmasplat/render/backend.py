"""Choose what computes: the compiled CPU kernels, or their definition in plain torch."""

from types import ModuleType

from sigmasplat import env
from sigmasplat.errors import BackendError
from sigmasplat.render import reference

BACKENDS = ("auto", "cpu", "reference")


def backend_module(name: str) -> ModuleType:
    """Return the module whose `project` and `blend` do the work; "auto" is SIGMASPLAT_BACKEND's, else the kernels.

    Raises BackendError if it is unknown or not built.
    """
    if name == "auto":
        name = env.switches().backend
    if name == "reference":
        return reference
    if name not in BACKENDS:
        raise BackendError(f"unknown backend {name!r} (known: {', '.join(BACKENDS)})")
    try:
        from sigmasplat.render import cpu
    except ImportError as problem:
        raise BackendError(
            f"the compiled kernels cannot be loaded ({problem}); reinstall with `pip install .`, or use the slow "
            "plain-torch backend: --set backend=reference --set tracking.method=adam"
        ) from problem
    return cpu
