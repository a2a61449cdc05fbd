"""Frames of a video file by number."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError

# FFmpeg would print its own lines about damaged files, besides the error raised here. OpenCV reads
# the level when the process uses FFmpeg for the first time.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


class VideoFile:
    """Decodes frames of a video; ascending numbers are fast.

    Frames are counted while decoding, since seeking is inexact in files with a variable frame rate:
    an earlier frame than the last one is found by decoding from the start again. Not for use by
    several threads at the same time.

    Args:
        path: of a file that FFmpeg reads, for instance .mp4 or .mov.
        rotated: whether rotation metadata is applied, so that frames are as they are shown.

    Raises:
        DatasetError: the file is missing or is not a video.
    """

    def __init__(self, path: Path, rotated: bool = True) -> None:
        self._path = path
        self._rotated = rotated
        self._next = 0
        self._capture = self._opened()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
        return int(self._capture.get(width)), int(self._capture.get(height))

    def rgb(self, number: int) -> NDArray[np.float32]:
        """Decode frame `number` >= 0 as [H, W, 3] float32 RGB in [0, 1].

        Raises:
            DatasetError: the video ends before it, or is damaged there.
        """
        if number < self._next:
            self._capture.release()
            self._capture, self._next = self._opened(), 0
        while self._next <= number:
            if not self._capture.grab():
                raise DatasetError(
                    f"{self._path} ends or is damaged after frame {self._next - 1}, but frame "
                    f"{number} is needed; copy the recording again"
                )
            self._next += 1
        decoded, bgr = self._capture.retrieve()
        if not decoded:
            raise DatasetError(f"frame {number} of {self._path} is damaged; copy the file again")
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.float32) / np.float32(255.0)

    def timestamps_s(self) -> dict[int, float]:
        """Time in seconds from the start by frame number, strictly increasing.

        Frames that do not advance the time, as some damaged files have, are left out.
        """
        capture = self._opened()
        times: dict[int, float] = {}
        last, number = -1.0, 0
        while capture.grab():
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if time_s > last:
                times[number] = last = time_s
            number += 1
        capture.release()
        return times

    def _opened(self) -> cv2.VideoCapture:
        if not self._path.is_file():
            raise DatasetError(f"cannot read {self._path}: no such file; check the path")
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            capture = cv2.VideoCapture(os.fsencode(self._path), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            raise DatasetError(
                f"{self._path} is damaged or not a video that FFmpeg reads; copy the file again"
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, float(self._rotated))
        return capture
