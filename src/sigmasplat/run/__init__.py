"""Run a sequence through SLAM into a run folder; resume, profile, show progress."""
