"""What the compiled CPU kernels do for the fits."""
