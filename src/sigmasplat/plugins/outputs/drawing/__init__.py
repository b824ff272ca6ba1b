"""Draw charts and view strips."""
