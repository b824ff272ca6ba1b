"""Read and write splats: PLY, compressed PLY, SPZ, .splat."""
