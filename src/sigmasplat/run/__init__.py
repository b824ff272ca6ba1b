"""Run SLAM on a sequence into a run folder; resume a run, measure its stages, show its progress."""
