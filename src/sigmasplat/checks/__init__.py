"""Check an installation, and a recording before a run."""
