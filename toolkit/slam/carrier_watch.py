"""Finds what moves with the camera while it runs, for frames that are not recorded yet."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame, without_pixels
from toolkit.base.geometry import se3
from toolkit.datasets.carrier import CellImages, find_carrier, note_about
from toolkit.datasets.resize import enlarge_mask
from toolkit.slam.submaps.submap import Submap

_log = logging.getLogger(__name__)

# Frames are compared when there are so many, in intervals that double without a result: with a
# camera that stands still at first, from 1 to 24 seconds after the start.
_COUNTS = (8, 16)
_FIRST_INTERVAL_S, _LAST_INTERVAL_S = 0.1, 1.6


class CarrierWatch:
    """Looks for the carrier of the camera in the first frames, and ignores it from then on."""

    def __init__(self) -> None:
        self._images: list[CellImages] = []
        self._next_s: float | None = None
        self._interval_s = _FIRST_INTERVAL_S
        self._mask = np.zeros((1, 1), bool)

    def of(self, frame: Frame, submap: Submap | None) -> Frame:
        """The next frame without the carrier.

        Args:
            submap: from which the carrier is removed when it is found; None without a map.
        """
        if self._looks_at(frame):
            self._mask = find_carrier(self._images)
            if self._mask.any():
                _log.info("Frame %d: %s.", frame.index, note_about(self._mask))
                if submap is not None:
                    _remove(submap, enlarge_mask(self._mask, frame.camera.size))
            elif len(self._images) == _COUNTS[-1]:
                self._images = self._images[::2]
                self._interval_s *= 2.0
        if not self._mask.any():
            return frame
        return without_pixels(frame, enlarge_mask(self._mask, frame.camera.size))

    def _looks_at(self, frame: Frame) -> bool:
        """Add a frame if it is time; return whether there are enough to compare."""
        if self._mask.any() or self._interval_s > _LAST_INTERVAL_S:
            return False
        if self._next_s is not None and frame.timestamp_s < self._next_s:
            return False
        self._images.append(CellImages.of(frame))
        self._next_s = frame.timestamp_s + self._interval_s
        return len(self._images) in _COUNTS

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and values from which `restore` continues identically."""
        arrays = {"mask": self._mask}
        if self._images:
            arrays["depth_m"] = np.stack([image.depth_m for image in self._images])
            arrays["rgb"] = np.stack([image.rgb for image in self._images])
        return arrays, {"next_s": self._next_s, "interval_s": self._interval_s}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._mask = np.array(arrays["mask"])
        images = zip(arrays.get("depth_m", ()), arrays.get("rgb", ()), strict=True)
        self._images = [CellImages(np.array(depth_m), np.array(rgb)) for depth_m, rgb in images]
        self._next_s, self._interval_s = values["next_s"], values["interval_s"]


def _remove(submap: Submap, mask: NDArray[np.bool_]) -> None:
    """Remove what keyframes have shown in a mask [H, W] from a submap."""
    hidden, last = torch.from_numpy(mask), np.array(mask.shape[::-1]) - 1
    means = submap.gaussians.means.detach().cpu().numpy()
    seeded_by, shows = submap.seeded_by.cpu().numpy(), np.zeros(len(means), bool)
    for keyframe in submap.keyframes:
        if keyframe.index < 0:
            continue  # of a loaded map
        keyframe.hide(hidden)
        own = np.flatnonzero(seeded_by == keyframe.index)
        points = se3.transform_points(se3.inverse(keyframe.T_map_camera), means[own])
        own, points = own[points[:, 2] > 0], points[points[:, 2] > 0]
        # Frames between keyframes add what is just outside of the image of a keyframe.
        pixels = np.clip(np.rint(keyframe.camera.project(points)), 0, last).astype(int)
        shows[own] = mask[pixels[:, 1], pixels[:, 0]]
    submap.views.clear()
    submap.remove(torch.from_numpy(shows).to(submap.device))
