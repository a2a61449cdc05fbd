"""The errors that the toolkit raises on purpose: one root, a few children.

A message is one line: what is wrong, which file or setting, and the remedy.
Programs print it and exit with a non-zero status.
"""


class ToolkitError(Exception):
    """Root of all errors that a user can mend."""


class DatasetError(ToolkitError):
    """A data set, or one file of it, is missing, unreadable or inconsistent."""


class SettingsError(ToolkitError):
    """A setting is unknown, of the wrong type or out of range."""


class FormatError(ToolkitError):
    """A file is not what its name or header says."""


class RunFolderError(ToolkitError):
    """A run folder cannot be written, read or resumed."""


class DependencyError(ToolkitError):
    """An optional package or a system library is missing."""
