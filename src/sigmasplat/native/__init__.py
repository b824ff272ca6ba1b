"""The compiled kernels: `_core`, built from the sources in this folder. It takes arrays and does not link torch."""
