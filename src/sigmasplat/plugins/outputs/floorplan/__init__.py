"""Make a floor plan of a map."""
