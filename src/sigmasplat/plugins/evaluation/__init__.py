"""Score runs against the ground truth and compare runs."""
