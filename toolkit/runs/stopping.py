"""Ctrl-C and SIGTERM, as batch systems and containers send it, end a job in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from toolkit.base.errors import Stopped

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """The signals that end a job.

    They raise `Stopped` in the main thread: at once, or at the next `check` within `deferred`. The
    second signal is not deferred.

    Attributes:
        number: the signal that was deferred, or None.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._deferred = False

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Handle the signals within a block; those that are ignored, as by nohup, stay ignored."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        chosen = [n for n in _SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        before = {number: signal.signal(number, self._received) for number in chosen}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Within a block, the first signal only sets `number`."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False

    def check(self) -> None:
        """End the job if a signal was deferred.

        Raises:
            Stopped: a signal was deferred.
        """
        if self.number is not None:
            raise Stopped(self.number)

    def _received(self, number: int, _frame: FrameType | None) -> None:
        if self.number is not None or not self._deferred:
            raise Stopped(number)
        self.number = number
