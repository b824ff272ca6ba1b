"""Render a synthetic room: shapes, textures, light, a camera path, and sensor noise."""
