"""The CUDA kernels, and their compilation. Experimental: they have never run on a GPU."""
