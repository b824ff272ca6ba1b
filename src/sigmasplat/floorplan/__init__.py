"""Draw a floor plan from a map, with regions to rescan."""
