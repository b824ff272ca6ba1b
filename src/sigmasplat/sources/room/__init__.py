"""Make a furnished room in code: shapes, textures, light, a camera's walk and a depth sensor's faults."""
