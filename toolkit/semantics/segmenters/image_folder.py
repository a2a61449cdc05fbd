"""Labels from a folder of PNG files."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.io.class_names import read_class_colours, read_class_names
from toolkit.io.images import read_labels, read_rgb
from toolkit.io.user_files import visible
from toolkit.semantics.segmenters.vocabulary import ClassVocabulary

_log = logging.getLogger(__name__)


class LabelImageFolder:
    """Labels from `STEM.png` files of class ids and a `classes.json` file in the same folder.

    Files contain 8- or 16-bit ids, or colours if `classes.json` has `colours`. They correspond to
    the frames of the run: undistorted and uncropped. Files of another size with the same aspect
    ratio are resampled to the nearest neighbour.

    Args:
        folder: folder of the files.
        stems: file names of the frames' images without suffix, by frame index; files are assigned
            by stem. Without them, the last number in a file's name is the frame's index.
        gaps: whether files may be missing; their frames are void, with one warning.

    Raises:
        DatasetError: the folder contains no PNG file or no valid `classes.json`, or its files
            cannot be assigned to frames.
    """

    def __init__(
        self, folder: Path, stems: Sequence[str] | None = None, gaps: bool = False
    ) -> None:
        self._folder = folder
        self._gaps = gaps
        self._warned = False
        names_file = folder / "classes.json"
        if not folder.is_dir():
            raise DatasetError(f"{folder} is not a folder; set the folder of the label images")
        self._vocabulary = ClassVocabulary(read_class_names(names_file), str(names_file))
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = self._vocabulary.names
        colours = read_class_colours(names_file)
        self._palette = None if colours is None else _Palette(colours, names_file)
        if colours is not None:
            self._vocabulary.check(np.array(list(colours)), f"{names_file}: colours")
        self._files = files_by_stem(folder, stems) if stems is not None else files_by_number(folder)

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """Return the labels [H, W] of the frame's file.

        Raises:
            DatasetError: the file is missing, cannot be read, has the wrong size, or contains an
                id or a colour without a name.
        """
        file = self._files.get(frame.index)
        if file is None:
            return self._missing(frame)
        labels = self._read(file)
        return resized_labels(labels, frame.camera.size, file)

    def _missing(self, frame: Frame) -> NDArray[np.int32]:
        if not self._gaps:
            raise DatasetError(
                f"{self._folder} has no label image for frame {frame.index}; add it, or set "
                "--segmenter.images.gaps to treat such frames as void"
            )
        if not self._warned:
            _log.warning(
                "%s has no label image for frame %d; frames without one are treated as void.",
                self._folder,
                frame.index,
            )
            self._warned = True
        return np.zeros(frame.depth_m.shape, np.int32)

    def _read(self, file: Path) -> NDArray[np.int32]:
        if self._palette is None:
            labels = read_labels(file)
            self._vocabulary.check(labels, str(file))
            return labels
        rgb = np.rint(read_rgb(file) * 255.0).astype(np.int64)
        ids = self._palette.ids(rgb)
        if (ids < 0).any():
            row, column = np.argwhere(ids < 0)[0]
            raise DatasetError(
                f"{file} has the colour {rgb[row, column].tolist()} at column {column}, row "
                f"{row}, which {self._folder / 'classes.json'} does not list; add it, or save "
                "the image without smoothing"
            )
        return ids

    def state(self) -> dict[str, NDArray]:
        """Return an empty state: frames are labelled independently."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Accept an earlier `state`, which is empty."""


class _Palette:
    """Class ids by colour; black is void.

    Raises:
        DatasetError: the colour of a class is black.
    """

    _CHANNEL_WEIGHTS = np.array([65536, 256, 1])

    def __init__(self, colours: Mapping[int, tuple[int, int, int]], names_file: Path) -> None:
        black = [number for number, colour in colours.items() if number and not any(colour)]
        if black:
            raise DatasetError(
                f"{names_file}: class {black[0]} is black, which is reserved for void; change its "
                "colour"
            )
        known = {(0, 0, 0): 0} | {colour: number for number, colour in colours.items()}
        codes = np.array(list(known)) @ self._CHANNEL_WEIGHTS
        order = np.argsort(codes)
        self._codes, self._ids = codes[order], np.array(list(known.values()))[order]

    def ids(self, rgb: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return class ids [H, W] of colours [H, W, 3] in 0..255; -1 for unknown colours."""
        codes = rgb @ self._CHANNEL_WEIGHTS
        index = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        return np.where(self._codes[index] == codes, self._ids[index], -1).astype(np.int32)


def _images(folder: Path) -> list[Path]:
    found = [f for f in visible(folder) if f.suffix.lower() == ".png"]
    if not found:
        raise DatasetError(f"{folder} contains no PNG file; set the folder of the label images")
    return found


def files_by_stem(folder: Path, stems: Sequence[str]) -> dict[int, Path]:
    """Assign files to frame indices by the stem of the frame's image."""
    files = {file.stem: file for file in _images(folder)}
    paired = {index: files[stem] for index, stem in enumerate(stems) if stem in files}
    if not paired:
        raise DatasetError(
            f"{folder}: no file has the name of a frame's image (expected for instance "
            f"{stems[0] if stems else 'none'}, found {next(iter(files))}); rename them, or "
            "pair by number"
        )
    return paired


def files_by_number(folder: Path) -> dict[int, Path]:
    """Assign files to frame indices by the last number in their names.

    Raises:
        DatasetError: a name has no number, two have the same number, or there is no number 0.
            Files numbered from 1 would shift the labels by one frame.
    """
    paired: dict[int, Path] = {}
    for file in _images(folder):
        numbers = re.findall(r"\d+", file.stem)
        if not numbers:
            raise DatasetError(f"{file} has no number in its name; rename it, or pair by stem")
        index = int(numbers[-1])
        if index in paired:
            raise DatasetError(
                f"{file} and {paired[index].name} both have number {index}; keep one"
            )
        paired[index] = file
    if 0 not in paired:
        raise DatasetError(
            f"{folder}: the numbers start at {min(paired)}, but frame indices start at 0; renumber "
            "the files, or pair by stem"
        )
    return paired


def resized_labels(
    labels: NDArray[np.int32], size: tuple[int, int], file: Path
) -> NDArray[np.int32]:
    """Resize labels [H, W] to (width, height) by nearest neighbour.

    Raises:
        DatasetError: the aspect ratios differ.
    """
    width, height = size
    old_height, old_width = labels.shape
    if (old_width, old_height) == size:
        return labels
    # Datasets scale their images to the nearest whole pixel and crop the remainder.
    scale = max(width / old_width, height / old_height)
    if (round(old_width * scale), round(old_height * scale)) != size:
        raise DatasetError(
            f"{file} is {old_width}x{old_height}, which does not scale to the frame's "
            f"{width}x{height}; create label images with the size or aspect ratio of the frames"
        )
    columns = ((np.arange(width) + 0.5) * (old_width / width)).astype(np.int64)
    rows = ((np.arange(height) + 0.5) * (old_height / height)).astype(np.int64)
    return labels[np.ix_(rows, columns)]
