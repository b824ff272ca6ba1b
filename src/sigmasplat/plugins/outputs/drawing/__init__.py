"""Draw charts, view strips, film images and contact sheets."""
