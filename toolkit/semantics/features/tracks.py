"""Feature tracks: corners that are followed from image to image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.features.keypoints import detect_keypoints, match_keypoints

Array = NDArray[np.float64]

# Quality of a corner relative to the best one in the image, and half the block that it is
# computed from.
_QUALITY = 0.005
_BLOCK = 7
# Distance between corners relative to that of a regular grid of all corners.
_SPACING = 0.6
_WINDOW_PX = 11
_LEVELS = 2
# Features whose track back to the previous image misses their origin by more are lost.
_MAX_RETURN_PX = 0.5
_BORDER_PX = 4.0
# Where optical flow keeps fewer features, matched keypoints predict where they are.
_MIN_FOLLOWED = 0.3
# Where more are followed, no other guess of their places is tried.
_MOSTLY_FOLLOWED = 0.6
_KEYPOINTS, _RATIO, _MIN_MATCHES, _MATCH_ERROR_PX = 600, 0.8, 8, 1.5
_NEIGHBOURS = 3
# Relative changes of brightness or contrast between two images that Lucas-Kanade need not mind.
_MAX_EXPOSURE_CHANGE = 0.15


@dataclass(frozen=True)
class Features:
    """Image points with identities.

    Attributes:
        ids: [N] int64, unique over the sequence.
        px: [N, 2] float64 pixels.
    """

    ids: NDArray[np.int64]
    px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, mask: NDArray[np.bool_]) -> Features:
        """The features of a mask [N]."""
        return Features(self.ids[mask], self.px[mask])


NO_FEATURES = Features(np.zeros(0, np.int64), np.zeros((0, 2)))


class FeatureTracks:
    """Follows features from image to image, and finds new ones.

    Dense optical flow predicts where a feature is, or keypoints after large motions; Lucas-Kanade
    finds the place precisely.

    Args:
        count: features per image.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._image: NDArray[np.uint8] | None = None
        self._next_id = 0
        self.features = NO_FEATURES

    @property
    def image(self) -> NDArray[np.uint8]:
        """The newest image [H, W]."""
        assert self._image is not None, "no image yet"
        return self._image

    def follow(self, image: NDArray[np.uint8], guesses: Sequence[Array] = ()) -> Features:
        """Follow the features into the next image [H, W]; those that are lost are removed.

        Args:
            guesses: [N, 2] pixels where the features may be, the likeliest first; by default, where
                dense optical flow leads.
        """
        last, self._image = self._image, image
        if last is None or not len(self.features):
            return self.features
        before = self.features.px.astype(np.float32)
        after, good = before, np.zeros(len(before), bool)
        tried = [
            (np.asarray(guess, np.float32), _LEVELS)
            for guess in guesses or (_flowed(last, image, before),)
        ]
        # A pattern that repeats within some pixels is another one at coarser levels.
        for guess, levels in [*tried, (before, 0)]:
            places, found = _followed(last, image, before, guess, levels)
            if found.sum() > good.sum():
                after, good = places, found
            if good.mean() >= _MOSTLY_FOLLOWED:
                break
        if good.mean() < _MIN_FOLLOWED:
            matched = _guess_by_keypoints(last, image, before)
            if matched is not None:
                places, found = _followed(last, image, before, matched)
                if found.sum() > good.sum():
                    after, good = places, found
        self.features = Features(self.features.ids[good], after[good].astype(np.float64))
        return self.features

    def continue_from(self, image: NDArray[np.uint8], features: Features) -> None:
        """Follow features from another image [H, W] into the next one."""
        self._image, self.features = image, features

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the features outside a mask [N]."""
        self.features = self.features.select(mask)

    def replenish(self) -> Features:
        """Find new corners in the newest image, away from the features; return all."""
        assert self._image is not None, "no image yet"
        missing = self._count - len(self.features)
        if missing <= 0:
            return self.features
        height, width = self._image.shape
        spacing = _SPACING * np.sqrt(width * height / self._count)
        mask = np.zeros((height, width), np.uint8)
        border = int(_BORDER_PX) + 1
        mask[border:-border, border:-border] = 255
        for x, y in np.round(self.features.px).astype(int):
            cv2.circle(mask, (int(x), int(y)), round(spacing), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            self._image, missing, _QUALITY, spacing, mask=mask, blockSize=_BLOCK
        )
        if corners is None:
            return self.features
        ids = np.arange(self._next_id, self._next_id + len(corners))
        self._next_id += len(corners)
        self.features = Features(
            np.concatenate([self.features.ids, ids]),
            np.concatenate([self.features.px, corners.reshape(-1, 2).astype(np.float64)]),
        )
        return self.features

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        arrays: dict[str, NDArray] = {"ids": self.features.ids, "px": self.features.px}
        arrays |= {} if self._image is None else {"image": self._image}
        return arrays | {"next_id": np.array(self._next_id)}

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self.features = Features(np.array(state["ids"]), np.array(state["px"]))
        self._image = np.array(state["image"]) if "image" in state else None
        self._next_id = int(state["next_id"])


def _flowed(
    last: NDArray[np.uint8], image: NDArray[np.uint8], before: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Places [N, 2] of features in the next image by dense optical flow."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(last, image, None)
    column, row = np.round(before).astype(int).T
    return np.asarray(before + flow[row, column])


def _followed(
    last: NDArray[np.uint8],
    image: NDArray[np.uint8],
    before: NDArray[np.float32],
    guess: NDArray[np.float32],
    levels: int = _LEVELS,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places [N, 2] of features in the next image, and which of them have been found."""
    last = _with_exposure_of(image, guess, last, before)
    after, found = _lucas_kanade(last, image, before, guess, levels)
    back, returned = _lucas_kanade(image, last, after, before, levels)
    height, width = image.shape
    inside = (after >= _BORDER_PX) & (after <= np.array([width, height]) - 1 - _BORDER_PX)
    good = found & returned & inside.all(1)
    good &= np.linalg.norm(back - before, axis=1) < _MAX_RETURN_PX
    return after, good


def _guess_by_keypoints(
    last: NDArray[np.uint8], image: NDArray[np.uint8], before: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """Approximate places [N, 2] of features in the next image from matched keypoints around.

    Keypoints are found again after motions that are too large for optical flow.
    """
    first, second = (detect_keypoints(one, _KEYPOINTS) for one in (last, image))
    matches = match_keypoints(first, second, _RATIO)
    if len(matches) < _MIN_MATCHES:
        return None
    px, other_px = first.px[matches[:, 0]], second.px[matches[:, 1]]
    _, inlier = cv2.findFundamentalMat(px, other_px, cv2.FM_RANSAC, _MATCH_ERROR_PX, 0.999)
    if inlier is None or inlier.sum() < _MIN_MATCHES:
        return None
    good = inlier.ravel() > 0
    motion = (other_px - px)[good]
    distances = ((before[:, None] - px[good]) ** 2).sum(axis=-1)
    near = np.argsort(distances, axis=1, kind="stable")[:, :_NEIGHBOURS]
    return before + np.median(motion[near], axis=1).astype(np.float32)


def _with_exposure_of(
    image: NDArray[np.uint8],
    px: NDArray[np.float32],
    other: NDArray[np.uint8],
    other_px: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """Another image at the exposure of an image, if their exposures are very different.

    Args:
        px, other_px: [N, 2] about the same points in both.
    """
    own, before = _levels(image, px), _levels(other, other_px)
    (low, middle, high), (low_before, middle_before, high_before) = (
        np.percentile(values, [10.0, 50.0, 90.0]) for values in (own, before)
    )
    gain = max(high - low, 1.0) / max(high_before - low_before, 1.0)
    brightness = max(middle, 1.0) / max(middle_before, 1.0)
    if max(abs(gain - 1.0), abs(brightness - 1.0)) < _MAX_EXPOSURE_CHANGE:
        return other
    levels = gain * (np.arange(256) - middle_before) + middle
    return cv2.LUT(other, np.round(levels).clip(0, 255).astype(np.uint8))


def _levels(image: NDArray[np.uint8], px: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Intensities [N] of a smoothed image at pixels."""
    column, row = np.round(px).astype(int).T
    height, width = image.shape
    smooth = cv2.blur(image, (5, 5))
    return np.asarray(smooth[row.clip(0, height - 1), column.clip(0, width - 1)])


def _lucas_kanade(
    first: NDArray[np.uint8],
    second: NDArray[np.uint8],
    px: NDArray[np.float32],
    guess: NDArray[np.float32],
    levels: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        px.reshape(-1, 1, 2),
        guess.reshape(-1, 1, 2).copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
    )
    return found.reshape(-1, 2), status.reshape(-1).astype(bool)
