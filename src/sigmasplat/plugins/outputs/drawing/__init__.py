"""Draw charts, view strips and contact sheets."""
