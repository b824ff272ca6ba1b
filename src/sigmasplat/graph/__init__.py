"""Close loops: find candidate submaps, register them, solve the pose graph."""
