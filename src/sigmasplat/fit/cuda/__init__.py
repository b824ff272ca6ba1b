"""Run the fits on the CUDA kernels. Experimental: this code has never run on a GPU."""
