"""Read RGB-D sequences: one module per format, each returns a `Source`; `open_source` recognises the format."""

from sigmasplat.sources.base import Source
from sigmasplat.sources.opening import open_source
from sigmasplat.sources.synthetic import SyntheticRoom

__all__ = ["Source", "SyntheticRoom", "open_source"]
