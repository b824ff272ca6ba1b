"""Define the errors that a user can cause. On the command line each is one line and exit code 2."""


class SigmaSplatError(Exception):
    """Base class; the message says in one line what is wrong, what was found and what to do."""


class SourceError(SigmaSplatError):
    """An input sequence is missing, unreadable, inconsistent or of unknown format."""


class ConfigError(SigmaSplatError):
    """A setting has an unknown name, a value out of range, or contradicts another one."""


class RunError(SigmaSplatError):
    """A run folder is not writable, already exists, or was not made by SigmaSplat."""


class BackendError(SigmaSplatError):
    """This machine or this build does not support the requested compute backend."""


class DownloadError(SigmaSplatError):
    """A download failed: unknown data set, no connection, damaged or unsafe archive, or disk full."""
