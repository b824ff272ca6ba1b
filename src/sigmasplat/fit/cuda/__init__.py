"""What the CUDA kernels do for the fits. Experimental: this code has never run on a GPU."""
