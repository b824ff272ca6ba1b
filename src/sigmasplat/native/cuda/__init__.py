"""The CUDA kernels and what compiles them. Experimental: they have never run on a GPU."""
