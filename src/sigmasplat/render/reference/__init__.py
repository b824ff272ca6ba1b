"""The definition of the kernels in plain torch."""
