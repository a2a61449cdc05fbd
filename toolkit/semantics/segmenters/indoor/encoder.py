"""The indoor network as an encoder: features of cells, from which a head tells any classes."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.options import GeometricOptions
from toolkit.semantics.segmenters.geometric.room import Room
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid
from toolkit.semantics.segmenters.indoor.network import shipped_weights
from toolkit.semantics.segmenters.indoor.segmenter import INDOOR_COLUMNS, levelled_channels

# Of L, a and b, so that their range is that of the other features.
_COLOUR_UNIT = 50.0


class IndoorEncoder:
    """Computes features of cells from depth by the indoor network, and from colour.

    Args:
        options: heights of the camera.
        side: the side of the images that is up.

    Attributes:
        channels: length D of a feature vector.
        longest_side: maximum number of cells across the image.
        digest: SHA-256 of the weights.
    """

    longest_side = INDOOR_COLUMNS

    def __init__(self, options: GeometricOptions | None = None, side: ImageSide = "top") -> None:
        self._options, self._side = options or GeometricOptions(), side
        self._weights = shipped_weights()
        self.digest = self._weights.digest

    def features(self, frame: Frame) -> Tensor:
        """Return the features [rows, columns, D] float32 of the cells of a frame."""
        grid = surface_grid(frame.depth_m, frame.camera, INDOOR_COLUMNS)
        room = Room(self._options.camera_height_m, self._side)
        channels = levelled_channels(room.update(grid, np.eye(4)), room)
        with torch.no_grad():
            columns = self._weights.columns(channels)
        return torch.cat([columns, _colours(frame, columns.shape[1:])]).permute(1, 2, 0)


def _colours(frame: Frame, size: torch.Size) -> Tensor:
    """Colour [8, h, w] of cells: L, a, b, their squares, and the products of L with a and b."""
    small = cv2.resize(frame.rgb, (size[1], size[0]), interpolation=cv2.INTER_AREA)
    lab = torch.from_numpy(cv2.cvtColor(small, cv2.COLOR_RGB2LAB)).permute(2, 0, 1) / _COLOUR_UNIT
    return torch.cat([lab, lab**2, lab[:1] * lab[1:]])
