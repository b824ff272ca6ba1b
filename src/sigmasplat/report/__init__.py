"""Build a run's report: one HTML page."""
