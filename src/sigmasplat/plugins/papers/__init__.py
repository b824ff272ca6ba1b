"""The settings of the published systems, one module each, and the tables of their papers."""
