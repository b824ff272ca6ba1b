"""Read RGB-D sequences: one module per format, each returns a `Source`; `open_source` recognises the format."""

from sigmasplat.api import Source, open_source
from sigmasplat.plugins.sources.synthetic import SyntheticRoom

__all__ = ["Source", "SyntheticRoom", "open_source"]
