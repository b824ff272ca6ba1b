"""Render with the CUDA kernels. Experimental: this code has never run on a GPU, only in emulation on the CPU."""
