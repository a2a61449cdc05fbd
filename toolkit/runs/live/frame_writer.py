"""Writes the frames of a live camera to disk, as a dataset of kind `folder`."""

from __future__ import annotations

import shutil
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import yaml

from toolkit.base.errors import RunFolderError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.io.atomic import cannot_write, write_text
from toolkit.io.images import write_depth_png, write_rgb

# Frames that wait for the disk, at most; more would fill the memory.
_MAX_PENDING = 8


class FrameWriter:
    """Writes colour, depth and time of frames in a background thread.

    Args:
        folder: of the dataset; it is created.
        camera: intrinsics of the frames.
        depth_scale: values per metre of the depth images.
        fps: nominal frame rate; the times of the frames are stored as well.

    Raises:
        RunFolderError: the folder cannot be written.
    """

    def __init__(self, folder: Path, camera: Camera, depth_scale: float, fps: float) -> None:
        self.folder = folder
        self._depth_scale = depth_scale
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="frames")
        self._pending: deque[Future[None]] = deque()
        try:
            for name in ("rgb", "depth"):
                (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error
        values = {**asdict(camera), "depth_scale": float(depth_scale), "fps": float(fps)}
        write_text(folder / "intrinsics.yaml", yaml.safe_dump(values, sort_keys=False))

    def write(self, frame: Frame) -> None:
        """Write a frame under its index; waits only if many frames are not written yet.

        Raises:
            RunFolderError: an earlier frame could not be written.
        """
        while self._pending and (self._pending[0].done() or len(self._pending) >= _MAX_PENDING):
            self._pending.popleft().result()
        self._pending.append(self._executor.submit(self._write, frame))

    def close(self) -> None:
        """Return when all frames are written, or have failed.

        Raises:
            RunFolderError: one cannot be written.
        """
        self._executor.shutdown(wait=True)
        while self._pending:
            self._pending.popleft().result()

    def remove(self) -> None:
        """Delete what was written."""
        self._executor.shutdown(wait=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _write(self, frame: Frame) -> None:
        stem = f"{frame.index:06d}"
        write_rgb(self.folder / "rgb" / f"{stem}.png", frame.rgb)
        write_depth_png(self.folder / "depth" / f"{stem}.png", frame.depth_m, self._depth_scale)
        times = self.folder / "timestamps.txt"
        try:
            # Appended last: a line means that both images are complete.
            with times.open("a", encoding="utf-8") as file:
                file.write(f"{stem} {frame.timestamp_s!r}\n")
        except OSError as error:
            raise RunFolderError(f"cannot write {times}: {error.strerror}") from error
