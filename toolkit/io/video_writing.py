"""Write videos: .mp4 (VP9, which browsers play) and small .gif."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.base.errors import DependencyError, FormatError
from toolkit.io.atomic import replacing

VIDEO_SUFFIXES = (".mp4", ".gif")

# Codecs by preference. OpenCV's wheels have no encoder for H.264; browsers do not play MPEG-4.
_CODECS = ("vp09", "mp4v")
_GIF_WIDTH, _GIF_FPS, _GIF_COLOURS = 320, 10, 96

RgbImage = NDArray[np.uint8]


def write_video(path: Path, images: Iterable[RgbImage], fps: int) -> int:
    """Write images as a video; a GIF has at most 320 pixels per row and 10 images per second.

    Args:
        path: the file, .mp4 or .gif.
        images: [H, W, 3] uint8 RGB, all of one size; iterated once.
        fps: images per second, >= 1.

    Returns:
        The number of images.

    Raises:
        DependencyError: OpenCV has no video encoder.
        FormatError: the suffix is not supported.
        RunFolderError: the file cannot be written.
        ValueError: there are no images.
    """
    if path.suffix not in VIDEO_SUFFIXES:
        raise FormatError(f"{path}: the name must end in {' or '.join(VIDEO_SUFFIXES)}")
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    with replacing(path) as temporary:
        return write(temporary, iter(images), fps)


def _write_mp4(path: Path, images: Iterator[RgbImage], fps: int) -> int:
    first = next(images, None)
    if first is None:
        raise ValueError("a video needs at least one image")
    # Encoders subsample colour by two, so sides must be even.
    height, width = (side - side % 2 for side in first.shape[:2])
    writer = _opened(path, (width, height), fps)
    count = 0
    image: RgbImage | None = first
    while image is not None:
        writer.write(np.ascontiguousarray(image[:height, :width, ::-1]))
        count += 1
        image = next(images, None)
    writer.release()
    return count


def _opened(path: Path, size: tuple[int, int], fps: int) -> cv2.VideoWriter:
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        for codec in _CODECS:
            fourcc = cv2.VideoWriter.fourcc(*codec)
            writer = cv2.VideoWriter(os.fsencode(path), cv2.CAP_FFMPEG, fourcc, fps, size)
            if writer.isOpened():
                return writer
    finally:
        cv2.utils.logging.setLogLevel(level)
    raise DependencyError(
        "this build of OpenCV cannot write .mp4; pip install opencv-python-headless, or write .gif"
    )


def _write_gif(path: Path, images: Iterator[RgbImage], fps: int) -> int:
    step = max(1, round(fps / _GIF_FPS))
    count, pages = 0, []
    for image in images:
        if count % step == 0:
            pages.append(_page(image))
        count += 1
    if not pages:
        raise ValueError("a video needs at least one image")
    pages[0].save(
        path,
        save_all=True,
        append_images=pages[1:],
        duration=round(1000 * step / fps),
        loop=0,
        optimize=True,
    )
    return count


def _page(image: RgbImage) -> Image.Image:
    height, width = image.shape[:2]
    if width > _GIF_WIDTH:
        size = (_GIF_WIDTH, round(height * _GIF_WIDTH / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    page = Image.fromarray(np.ascontiguousarray(image))
    return page.quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
