"""Hold the compiled kernels: `_core`, built from the sources beside this file; it knows numpy arrays and tensors, not torch."""
