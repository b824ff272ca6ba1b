"""Render splats: project them, blend them, and compute maps from the blended sums."""

from sigmasplat.render.render import FieldRenderer, Render, render

__all__ = ["FieldRenderer", "Render", "render"]
