"""Render with the compiled CPU kernels."""
