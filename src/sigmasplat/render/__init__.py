"""See: project splats, blend them, and read maps off what was gathered."""

from sigmasplat.render.render import Render, render

__all__ = ["Render", "render"]
