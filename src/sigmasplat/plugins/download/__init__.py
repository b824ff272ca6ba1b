"""Download public data sets: catalogue, resumable downloads, and safe unpacking of archives."""

from sigmasplat.plugins.download.catalogue import describe_recordings, describe_sets, find_recording
from sigmasplat.plugins.download.downloader import download_recording

__all__ = ["describe_recordings", "describe_sets", "download_recording", "find_recording"]
