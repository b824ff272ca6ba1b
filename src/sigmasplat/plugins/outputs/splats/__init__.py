"""Read and write splats in the formats of other programs."""
