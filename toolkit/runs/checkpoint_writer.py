"""Saving of checkpoints during a run."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.runs.folder import RunFolder
from toolkit.slam.result import FrameResult
from toolkit.slam.submaps.atlas import Atlas


class System(Protocol):
    """A SLAM system that frames are given to: `Slam`, or one that paces it."""

    @property
    def atlas(self) -> Atlas:
        """All submaps."""

    def process_frame(self, frame: Frame, may_map: bool = True) -> FrameResult:
        """Process the next frame; see `Slam`."""

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """State for checkpoints; see `Slam`."""


class CheckpointWriter:
    """Saves the state of a system, on request in a background thread.

    In real time, writing would delay the frames that arrive meanwhile by about 0.3 s for 100 MB.

    Args:
        folder: of the run.
        background: copy the state and return before it is written.
        identity: identifies a number of frames from the start of the recording, so that the run is
            resumed with the same ones; None for frames of a camera.
    """

    def __init__(
        self,
        folder: RunFolder,
        background: bool,
        identity: Callable[[int], dict[str, str]] | None = None,
    ) -> None:
        self._folder, self._identity = folder, identity
        self._executor = ThreadPoolExecutor(max_workers=1) if background else None
        self._pending: Future[None] | None = None

    def save(self, system: System, next_frame: int) -> None:
        """Save a checkpoint after the frame before `next_frame`.

        Raises:
            RunFolderError: this checkpoint, or the one before, cannot be written.
        """
        self.wait()
        arrays, values = system.state()
        frames = {} if self._identity is None else self._identity(next_frame)
        if self._executor is None:
            self._folder.checkpoints.save(next_frame, arrays, values, frames)
        else:
            copies = {name: np.array(array) for name, array in arrays.items()}
            self._pending = self._executor.submit(
                self._folder.checkpoints.save, next_frame, copies, values, frames
            )
        system.atlas.checkpointed()

    def wait(self) -> None:
        """Return when all checkpoints are written.

        Raises:
            RunFolderError: one cannot be written.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()
