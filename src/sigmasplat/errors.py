"""Name every error a user can cause: one family, one line each, exit code 2 at the command line."""


class SigmaSplatError(Exception):
    """Say what was wrong, what was found and what to do, in one line."""


class SourceError(SigmaSplatError):
    """Refuse an input sequence: missing, unreadable, inconsistent or of unknown format."""


class ConfigError(SigmaSplatError):
    """Refuse a setting: unknown name, value out of range, settings that contradict each other."""


class RunError(SigmaSplatError):
    """Refuse a run folder: not writable, already there, or not one of ours."""


class BackendError(SigmaSplatError):
    """Refuse a compute backend that this machine or this build does not have."""


class DownloadError(SigmaSplatError):
    """Refuse or give up a download: no such set, no connection, damaged, unsafe to unpack, no room."""
