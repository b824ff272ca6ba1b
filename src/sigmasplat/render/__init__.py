"""See: project splats, blend them, and read maps off what was gathered."""

from sigmasplat.render.render import FieldRenderer, Render, render

__all__ = ["FieldRenderer", "Render", "render"]
