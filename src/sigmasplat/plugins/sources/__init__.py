"""Read RGB-D sequences: one module per format, each returns a `Source`; `open_source` recognises the format."""

from sigmasplat.input.opening import open_source
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources.synthetic import SyntheticRoom

__all__ = ["Source", "SyntheticRoom", "open_source"]
