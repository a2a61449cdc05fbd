"""Depth maps from a folder of files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.resize import ImageGrid
from toolkit.depth.depth_priors.options import DepthMapOptions
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    Image,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.io.exr import read_exr
from toolkit.io.guarded.arrays import read_array
from toolkit.io.guarded.content import read_content
from toolkit.io.guarded.images import decoded
from toolkit.io.images import read_labels
from toolkit.io.user_files import visible

_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr")
# Values of 16-bit PNG files per unit of depth, or of inverse depth.
_PNG_SCALE = np.float32(1000.0)
# Largest relative difference of aspect ratios that belong to the same field of view.
_SAME_ASPECT = 0.02


class DepthMapFolder:
    """Depth maps from files with the names of the frames' images.

    Maps show the whole image file, at any size, or the frame as the run uses it (`--image-size`).

    Args:
        options: folder and meaning of the values.
        stems: names of the frames' images without suffix, by frame index.
        source: intrinsics of the image files, at their size.

    Raises:
        DatasetError: the folder is missing, or has no map for any frame.
    """

    joint = False

    def __init__(self, options: DepthMapOptions, stems: Sequence[str], source: Camera) -> None:
        folder = options.folder
        if folder is None or not folder.is_dir():
            raise DatasetError(f"{folder} is not a folder; set --depth-prior.maps.folder")
        found = {f.stem: f for f in visible(folder) if f.suffix.lower() in _SUFFIXES}
        self._files = {i: found[stem] for i, stem in enumerate(stems) if stem in found}
        if not self._files:
            raise DatasetError(
                f"{folder} has no depth map with the name of a frame's image (expected for "
                f"instance {stems[0]}.npy); name the maps like the images"
            )
        self._folder, self._options, self._source = folder, options, source
        self.model = PriorModel(f"maps in {folder}")

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Read the maps of some frames.

        Raises:
            DatasetError: a map is missing, unreadable, or of another aspect ratio.
            DependencyError: the package that reads EXR is not installed.
        """
        priors = tuple(self._prior(frame) for frame in frames)
        return PriorSet(tuple(frame.index for frame in frames), priors)

    def _prior(self, frame: Frame) -> DepthPrior:
        file = self._files.get(frame.index)
        if file is None:
            raise DatasetError(
                f"{self._folder} has no depth map for frame {frame.index}; add it, or limit the run"
            )
        values = read_map(file)
        return DepthPrior(
            values,
            DepthKind(self._options.values),
            ScaleScope(self._options.scope),
            self.model,
            self._mapping(frame.camera, values, file),
            mask=np.isfinite(values) & (values != 0),
        )

    def _mapping(self, frame: Camera, values: Image, file: Path) -> PixelMapping:
        height, width = values.shape
        # The intrinsics of the frame may have been estimated since; those of the files were not.
        source, own = self._source, ImageGrid(self._source, frame.size).camera
        for shown in (source, own):
            if abs(width * shown.height / (height * shown.width) - 1.0) < _SAME_ASPECT:
                scaled = shown.scaled(width / shown.width, height / shown.height, width, height)
                return PixelMapping.between(own, scaled)
        raise DatasetError(
            f"{file} is {width}x{height}, but the images are {source.width}x{source.height}; save "
            "maps with the aspect ratio of the images"
        )


def read_map(file: Path) -> Image:
    """Read a map [h, w] float32.

    Raises:
        DatasetError: the file is unreadable, or has more than one channel.
        DependencyError: the package that reads EXR is not installed.
    """
    suffix = file.suffix.lower()
    try:
        if suffix == ".npy":
            values = read_array(file)
        elif suffix == ".png":
            return read_labels(file).astype(np.float32) / _PNG_SCALE
        elif suffix == ".exr":
            values = read_exr(file, "depth-priors")
        else:
            values = decoded(read_content(file), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError) as error:
        raise DatasetError(f"depth map {file} is unreadable ({error}); write it again") from error
    values = np.squeeze(values)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise DatasetError(
            f"depth map {file} has shape {list(values.shape)} and type {values.dtype}; save one "
            "channel of numbers"
        )
    return np.ascontiguousarray(values, np.float32)
