"""Read RGB-D sequences: one file per format, all of them a `Source`; `open_source` guesses which."""

from sigmasplat.sources.base import Source
from sigmasplat.sources.opening import open_source
from sigmasplat.sources.synthetic import SyntheticRoom

__all__ = ["Source", "SyntheticRoom", "open_source"]
