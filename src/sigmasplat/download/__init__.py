"""Download public data sets: a catalogue of values, a fetcher that resumes, an unpacker that trusts no archive."""

from sigmasplat.download.downloader import obtain
from sigmasplat.download.lookup import describe_recordings, describe_sets, find

__all__ = ["describe_recordings", "describe_sets", "find", "obtain"]
