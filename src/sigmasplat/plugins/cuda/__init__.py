"""The kernels on NVIDIA GPUs: compiled for the GPU at hand at run time, launched, and offered as a backend."""
