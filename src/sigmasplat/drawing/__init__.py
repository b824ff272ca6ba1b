"""Draw images, charts and contact sheets."""
