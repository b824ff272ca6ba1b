"""Hold the compiled kernels: `_core`, built from the sources beside this file; it takes arrays and links no torch."""
