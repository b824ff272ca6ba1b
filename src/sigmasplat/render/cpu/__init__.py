"""Rendering by the compiled CPU kernels."""
