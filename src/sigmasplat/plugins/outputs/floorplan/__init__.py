"""Make a floor plan of a map, with the regions to scan again."""
