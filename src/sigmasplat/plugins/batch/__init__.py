"""Make many runs, each in a process of its own, on this machine or on a cluster, and write their tables."""
