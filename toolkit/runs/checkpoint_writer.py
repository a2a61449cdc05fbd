"""Saving of checkpoints during a run."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.frame import Frame
from toolkit.runs.folder import RunFolder
from toolkit.slam.result import FrameResult
from toolkit.submaps.atlas import Atlas


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
    """

    def __init__(self, folder: RunFolder, background: bool) -> None:
        self._folder = folder
        self._executor = ThreadPoolExecutor(max_workers=1) if background else None
        self._pending: Future[None] | None = None

    def save(self, system: System, next_frame: int) -> None:
        """Save a checkpoint after the frame before `next_frame`.

        Raises:
            RunFolderError: this checkpoint, or the one before, cannot be written.
        """
        self.wait()
        arrays, values = system.state()
        if self._executor is None:
            self._folder.save_checkpoint(next_frame, arrays, values)
        else:
            copies = {name: np.array(array) for name, array in arrays.items()}
            self._pending = self._executor.submit(
                self._folder.save_checkpoint, next_frame, copies, values
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
