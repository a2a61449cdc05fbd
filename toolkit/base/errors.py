"""Exceptions of the toolkit.

A message is one line: what is wrong, which file or setting is affected, and how to fix it. Programs
print the message and exit with a non-zero status.
"""

from __future__ import annotations

import re
import signal

from toolkit.base.printable import printable

# Longer messages quote a file: their start names it, and their end says what to do.
_MAX_START, _MAX_END = 380, 180


class ToolkitError(Exception):
    """Base class of all errors that a user can fix.

    Args:
        message: made one line without control characters, and shortened in its middle if it is
            long.
    """

    def __init__(self, message: str = "") -> None:
        message = printable(re.sub(r"\s*\n\s*", " ", message.strip()))
        if len(message) > _MAX_START + _MAX_END:
            message = f"{message[:_MAX_START]} ... {message[-_MAX_END:]}"
        super().__init__(message)


class DatasetError(ToolkitError):
    """A dataset or one of its files is missing, unreadable or inconsistent."""


class SettingsError(ToolkitError):
    """A setting is unknown, has the wrong type or is out of range."""


class FormatError(ToolkitError):
    """A file is damaged or does not have the expected format."""


class RunFolderError(ToolkitError):
    """A run folder cannot be written, read or resumed."""


class DependencyError(ToolkitError):
    """An optional package or a system library is missing."""


class MemoryLimitError(ToolkitError):
    """A run has nearly used up the memory that it may use."""


class Stopped(KeyboardInterrupt):
    """A signal ended a job.

    Args:
        number: of the signal.
        state: what was saved and how to continue, for messages.
    """

    def __init__(self, number: int, state: str = "") -> None:
        word = "interrupted" if number == signal.SIGINT else "terminated"
        super().__init__(f"{word}; {state}" if state else word)
        self.number = number

    @property
    def status(self) -> int:
        """Exit status, as in shells."""
        return 128 + self.number


class CameraError(ToolkitError):
    """A live camera is missing, was disconnected or sends no frames."""
