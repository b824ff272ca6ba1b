"""The presets: each module registers its own as `PLUGIN`."""
