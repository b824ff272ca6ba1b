"""The definition of both kernels in plain torch."""
