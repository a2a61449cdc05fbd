"""Labels from a folder of PNG files that any tool wrote."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError
from toolkit.frame import Frame
from toolkit.io.class_names import read_class_colours, read_class_names
from toolkit.io.images import read_labels, read_rgb
from toolkit.semantics.segmenters.vocabulary import Vocabulary

_log = logging.getLogger(__name__)


class LabelImageFolder:
    """Labels from `STEM.png` files of class ids with `classes.json` beside them.

    Files hold 8- or 16-bit ids, or colours where `classes.json` has `colours`. They belong to
    the images as the run sees them, undistorted and uncropped, and may be of another size
    with the same aspect ratio: then each pixel takes the one that holds its centre.

    Args:
        folder: where they lie.
        stems: the names, without suffix, of the frames' own images by index: files pair by
            stem. Without them, the last number in a file's name is the frame's index.
        gaps: whether frames may lack a file; they are void, with one warning.

    Raises:
        DatasetError: the folder holds no PNG file or no valid `classes.json`, or its files
            do not pair with frames.
    """

    def __init__(
        self, folder: Path, stems: Sequence[str] | None = None, gaps: bool = False
    ) -> None:
        self._folder = folder
        self._gaps = gaps
        self._warned = False
        names_file = folder / "classes.json"
        if not folder.is_dir():
            raise DatasetError(f"{folder} is no folder; give the folder of the label images")
        self._vocabulary = Vocabulary(read_class_names(names_file), str(names_file))
        self.place_divergence = 0.4
        self.class_names: Mapping[int, str] = self._vocabulary.names
        colours = read_class_colours(names_file)
        self._palette = None if colours is None else _Palette(colours, names_file)
        if colours is not None:
            self._vocabulary.check(np.array(list(colours)), f"{names_file}: colours")
        self._files = _by_stem(folder, stems) if stems is not None else _by_number(folder)

    def segment(
        self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None
    ) -> NDArray[np.int32]:
        """The labels [H, W] of the frame's file.

        Raises:
            DatasetError: there is none, it cannot be read, its size does not fit, or it holds
                an id or a colour without a name.
        """
        file = self._files.get(frame.index)
        if file is None:
            return self._missing(frame)
        labels = self._read(file)
        return _resized(labels, frame.camera.size, file)

    def _missing(self, frame: Frame) -> NDArray[np.int32]:
        if not self._gaps:
            raise DatasetError(
                f"{self._folder} has no label image for frame {frame.index}; add it, or allow "
                "gaps (frames without labels are void)"
            )
        if not self._warned:
            _log.warning(
                "%s has no label image for frame %d; it, and others like it, count as void",
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
        """Nothing: every frame stands for itself."""
        return {}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`, which is empty."""


class _Palette:
    """Class ids by colour; black is void.

    Raises:
        DatasetError: a class is black.
    """

    _PLACES = np.array([65536, 256, 1])

    def __init__(self, colours: Mapping[int, tuple[int, int, int]], names_file: Path) -> None:
        black = [number for number, colour in colours.items() if number and not any(colour)]
        if black:
            raise DatasetError(
                f"{names_file}: class {black[0]} is black, which is void; recolour it"
            )
        known = {(0, 0, 0): 0} | {colour: number for number, colour in colours.items()}
        codes = np.array(list(known)) @ self._PLACES
        order = np.argsort(codes)
        self._codes, self._ids = codes[order], np.array(list(known.values()))[order]

    def ids(self, rgb: NDArray[np.int64]) -> NDArray[np.int32]:
        """Class ids [H, W] of colours [H, W, 3] from 0 to 255; -1 where there is none."""
        codes = rgb @ self._PLACES
        place = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        return np.where(self._codes[place] == codes, self._ids[place], -1).astype(np.int32)


def _images(folder: Path) -> list[Path]:
    found = sorted(f for f in folder.iterdir() if f.suffix.lower() == ".png")
    if not found:
        raise DatasetError(f"{folder} holds no PNG file; give the folder of the label images")
    return found


def _by_stem(folder: Path, stems: Sequence[str]) -> dict[int, Path]:
    """Files by the index of the frame whose image has their stem."""
    files = {file.stem: file for file in _images(folder)}
    paired = {index: files[stem] for index, stem in enumerate(stems) if stem in files}
    if not paired:
        raise DatasetError(
            f"{folder}: no file is called like a frame's image ({stems[0] if stems else 'none'} "
            f"was looked for, {next(iter(files))} is there); rename them, or pair by number"
        )
    return paired


def _by_number(folder: Path) -> dict[int, Path]:
    """Files by the last number in their names.

    Raises:
        DatasetError: a name has no number, two have the same, or counting begins after 0,
            which would shift every label by a frame.
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
            f"{folder}: numbers begin at {min(paired)}, but frames count from 0; renumber the "
            "files, or pair by stem"
        )
    return paired


def _resized(labels: NDArray[np.int32], size: tuple[int, int], file: Path) -> NDArray[np.int32]:
    """Labels [H, W] at (width, height): each pixel takes the one that holds its centre.

    Raises:
        DatasetError: the aspect ratio is another one.
    """
    width, height = size
    old_height, old_width = labels.shape
    if (old_width, old_height) == size:
        return labels
    # As a data set scales its own images, to the nearest whole pixel; it would crop the rest.
    scale = max(width / old_width, height / old_height)
    if (round(old_width * scale), round(old_height * scale)) != size:
        raise DatasetError(
            f"{file} is {old_width}x{old_height}, which does not scale to the frame's "
            f"{width}x{height}; make label images of the frames as the run sees them"
        )
    columns = ((np.arange(width) + 0.5) * (old_width / width)).astype(np.int64)
    rows = ((np.arange(height) + 0.5) * (old_height / height)).astype(np.int64)
    return labels[np.ix_(rows, columns)]
