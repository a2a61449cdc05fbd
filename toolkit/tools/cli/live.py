"""`semsplat live`: track and map the frames of a camera while they arrive."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from types import FrameType

from toolkit.base.errors import Stopped
from toolkit.runs.live.options import LiveOptions
from toolkit.runs.stopping import StopSignals
from toolkit.tools.cli.run import (
    RunArguments,
    parse_run,
    progress_observers,
    resumption,
    with_progress,
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LiveProgram(LiveOptions, RunArguments):
    """Track and map the frames of a depth camera while they arrive, or of a dataset as if it were
    one, and write a run folder. Ctrl-C ends the recording and finishes the map; SIGTERM saves a
    checkpoint, which semsplat run resumes."""

    @property
    def live(self) -> LiveOptions:
        """The options of the camera."""
        return LiveOptions(**{f.name: getattr(self, f.name) for f in fields(LiveOptions)})


def main(argv: Sequence[str]) -> int:
    """Run SLAM on a camera.

    Raises:
        ToolkitError: bad settings, data or output folder, or a camera that was disconnected.
    """
    program = parse_run(LiveProgram, list(argv), "live")
    # Imports torch, which takes seconds; wrong arguments are reported before.
    from toolkit.runs.live.execution import LiveHooks, run_live
    from toolkit.runs.live.factory import build_camera

    observers = progress_observers(program)
    camera = build_camera(program.live, program.settings)
    hooks = LiveHooks(progress=with_progress, observers=observers)
    try:
        with stopped_by_signals(hooks.stop, hooks.signals):
            run_live(program.settings, program.live, camera, program.out, hooks)
    except Stopped as stopped:
        words = ["--config", str(program.out / "config.yaml"), "--out", str(program.out)]
        raise Stopped(stopped.number, resumption(program.out, words)) from None
    return 0


@contextmanager
def stopped_by_signals(stop: threading.Event, signals: StopSignals) -> Iterator[None]:
    """Let the first Ctrl-C or SIGTERM set an event; a second Ctrl-C interrupts the program.

    Args:
        stop: the event.
        signals: is told of SIGTERM, after which there is no time to finish the map.
    """

    def interrupted(_number: int, _frame: FrameType | None) -> None:
        # Background jobs of shells start with the signal ignored, so `before` may not interrupt.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _log.info("Finishing the map; press Ctrl-C again to stop at once.")
        stop.set()

    def terminated(number: int, _frame: FrameType | None) -> None:
        signals.number = number
        stop.set()

    before = signal.signal(signal.SIGINT, interrupted)
    ended = signal.signal(signal.SIGTERM, terminated)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGTERM, ended)
