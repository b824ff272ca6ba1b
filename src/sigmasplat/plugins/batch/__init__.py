"""Make many runs, each in a process of its own, and write their tables."""
