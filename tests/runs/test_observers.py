"""Observers of a run: all are notified, and one that fails is left out."""

from __future__ import annotations

import logging

from toolkit.runs.observers import Observers


class Listener:
    def __init__(self, fails_at: str = "") -> None:
        self.calls: list[str] = []
        self._fails_at = fails_at

    def _called(self, name: str) -> None:
        self.calls.append(name)
        if name == self._fails_at:
            raise OSError("disk full")

    def started(self, run) -> None:
        self._called("started")

    def frame_processed(self, frame, result) -> None:
        self._called("frame")

    def finished(self, result) -> None:
        self._called("finished")

    def close(self) -> None:
        self._called("close")


def follow(observers: Observers) -> None:
    observers.started(None)
    observers.frame_processed(None, None)
    observers.frame_processed(None, None)
    observers.finished(None)
    observers.close()


def test_all_observers_are_notified_of_everything_in_order():
    first, second = Listener(), Listener()
    follow(Observers([first, second]))
    assert first.calls == ["started", "frame", "frame", "finished", "close"]
    assert second.calls == first.calls


def test_an_observer_that_fails_is_reported_and_left_out(caplog):
    failing, other = Listener("frame"), Listener()
    with caplog.at_level(logging.WARNING, "toolkit"):
        follow(Observers([failing, other]))
    assert failing.calls == ["started", "frame", "close"]
    assert other.calls[-1] == "close" and len(other.calls) == 5
    assert caplog.text.count("Listener failed and is no longer called: disk full") == 1
