"""Run the fits on the compiled CPU kernels."""
