"""Depth priors: what a model or a file says about the depth of an image, and its interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Neighbouring values that differ by more than this fraction of the median belong to two surfaces,
# and are not interpolated.
_EDGE = 0.03


class DepthKind(Enum):
    """How the values of a prior relate to the z-depth z of a pixel, with unknown a > 0 and b."""

    METRIC = "metric"
    """z in metres."""
    SCALED = "scaled"
    """a z."""
    AFFINE = "affine"
    """a z + b."""
    AFFINE_INVERSE = "affine-inverse"
    """a / z + b."""

    @property
    def inverse(self) -> bool:
        """Whether near pixels have high values."""
        return self is DepthKind.AFFINE_INVERSE

    @property
    def has_shift(self) -> bool:
        """Whether b may differ from 0."""
        return self in (DepthKind.AFFINE, DepthKind.AFFINE_INVERSE)


class ScaleScope(Enum):
    """Which images share the unknown scale and shift of a prior."""

    FRAME = "frame"
    SET = "set"
    SEQUENCE = "sequence"


@dataclass(frozen=True)
class PriorModel:
    """What produced a prior.

    Attributes:
        name: of the model, or of the folder that contains its depth maps.
        sha256: of its weights; None if they are not at hand.
        licence: of its weights, as far as it is known.
    """

    name: str
    sha256: str | None = None
    licence: str = "unknown"


@dataclass(frozen=True)
class Confidence:
    """Confidence of the values of a prior.

    Attributes:
        values: [h, w] float32; higher is more reliable.
        minimum: pixels with a lower value are not used.
    """

    values: Image
    minimum: float = 0.0


@dataclass(frozen=True)
class PixelMapping:
    """Crop and resize from a frame to the image that a model was given, per axis.

    Pixel centres are at integers: pixel u of the frame is at `scale (u + 0.5) + offset - 0.5` in
    the model's image. Where the model pads, offsets are positive; where it crops, negative.

    Attributes:
        scale: (x, y). offset: (x, y) in pixels of the model's image.
    """

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def resize(cls, source: tuple[int, int], target: tuple[int, int]) -> PixelMapping:
        """Mapping of a frame of (width, height) that is resized as a whole to another size."""
        return cls((target[0] / source[0], target[1] / source[1]))

    @classmethod
    def between(cls, frame: Camera, prior: Camera) -> PixelMapping:
        """Mapping between two images of the same view with different intrinsics."""
        scale = (prior.fx / frame.fx, prior.fy / frame.fy)
        centres = ((frame.cx, prior.cx), (frame.cy, prior.cy))
        offset = [p + 0.5 - s * (f + 0.5) for s, (f, p) in zip(scale, centres, strict=True)]
        return cls(scale, (offset[0], offset[1]))

    def then(self, other: PixelMapping) -> PixelMapping:
        """This mapping, followed by another one of its result."""
        scale = [a * b for a, b in zip(self.scale, other.scale, strict=True)]
        offset = [a * b + c for a, b, c in zip(self.offset, other.scale, other.offset, strict=True)]
        return PixelMapping((scale[0], scale[1]), (offset[0], offset[1]))

    def pixels(self, size: tuple[int, int]) -> tuple[Image, Image]:
        """Columns and rows [H, W] in the model's image of the pixels of a frame (width, height)."""
        axes = [
            np.float32(scale) * (np.arange(count, dtype=np.float32) + 0.5) + np.float32(shift - 0.5)
            for scale, shift, count in zip(self.scale, self.offset, size, strict=True)
        ]
        columns, rows = np.meshgrid(*axes)
        return columns, rows


@dataclass(frozen=True)
class DepthPrior:
    """What a model says about the depth of one image.

    Attributes:
        values: [h, w] float32; not finite where there is none.
        kind: how values relate to depth. Values of all kinds but the inverse one are z-depth, not
            distances along the ray.
        scope: which images share scale and shift.
        model: what produced it.
        pixels: from pixels of the frame to pixels of `values`.
        confidence: of the values, or None.
        mask: [h, w], False where the model predicts that there is no depth (sky); or None.
        camera: intrinsics that the model estimated, at the size of `values`; or None.
    """

    values: Image
    kind: DepthKind
    scope: ScaleScope
    model: PriorModel
    pixels: PixelMapping = PixelMapping()
    confidence: Confidence | None = None
    mask: Mask | None = None
    camera: Camera | None = None

    def __post_init__(self) -> None:
        shape = self.values.shape
        if self.values.dtype != np.float32 or self.values.ndim != 2:
            raise ValueError(f"values must be float32 [h, w], got {self.values.dtype} {shape}")
        for name, image in (
            ("confidence", None if self.confidence is None else self.confidence.values),
            ("mask", self.mask),
        ):
            if image is not None and image.shape != shape:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(image.shape)}")
        if self.camera is not None and self.camera.size != shape[::-1]:
            raise ValueError(f"camera must have the size {shape[::-1]}, got {self.camera.size}")

    @property
    def valid(self) -> Mask:
        """Mask [h, w] of the values that can be used."""
        valid = np.isfinite(self.values)
        if self.mask is not None:
            valid &= self.mask
        if self.confidence is not None:
            valid &= self.confidence.values >= self.confidence.minimum
        if not self.kind.has_shift:
            valid &= self.values > 0
        return valid

    def in_frame(self, size: tuple[int, int]) -> PriorImage:
        """The prior at the pixels of its frame.

        Args:
            size: (width, height) of the frame.
        """
        columns, rows = self.pixels.pixels(size)
        height, width = self.values.shape
        inside = (columns > -0.5) & (rows > -0.5) & (columns < width - 0.5) & (rows < height - 0.5)
        valid = self.valid
        values = np.where(valid, self.values, 0.0).astype(np.float32)
        nearest = cv2.remap(values, columns, rows, cv2.INTER_NEAREST)
        smooth = cv2.remap(values, columns, rows, cv2.INTER_LINEAR)
        known = inside & (cv2.remap(valid.astype(np.uint8), columns, rows, cv2.INTER_NEAREST) > 0)
        step = _EDGE * float(np.median(np.abs(values[valid]))) if valid.any() else 0.0
        weights = None
        if self.confidence is not None:
            confidence = np.where(valid, self.confidence.values, 0.0).astype(np.float32)
            typical = float(np.median(confidence[valid])) if valid.any() else 0.0
            relative = np.clip(confidence / max(typical, 1e-9), 0.0, 1.0)
            weights = cv2.remap(relative, columns, rows, cv2.INTER_NEAREST)
        return PriorImage(
            np.where(np.abs(smooth - nearest) < step, smooth, nearest), known, self.kind, weights
        )


@dataclass(frozen=True)
class PriorImage:
    """A prior at the pixels of its frame.

    Attributes:
        values: [H, W] float32. known: [H, W], where there is a value.
        kind: how values relate to depth.
        weights: [H, W] float32 in [0, 1], confidence relative to the median; None if all are equal.
    """

    values: Image
    known: Mask
    kind: DepthKind
    weights: Image | None = None


@dataclass(frozen=True)
class PriorSet:
    """Priors of images that a model was given together.

    Attributes:
        indices: of their frames.
        priors: one per frame.
        T_first_camera: [S, 4, 4] relative poses that the model estimated, or None. The unit of
            length is that of the depth.
    """

    indices: tuple[int, ...]
    priors: tuple[DepthPrior, ...]
    T_first_camera: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if len(self.indices) != len(self.priors):
            raise ValueError(f"{len(self.indices)} frames have {len(self.priors)} priors")
        poses = self.T_first_camera
        if poses is not None and poses.shape != (len(self.priors), 4, 4):
            raise ValueError(f"T_first_camera must be [{len(self.priors)}, 4, 4]")


class DepthProvider(Protocol):
    """Source of depth priors."""

    @property
    def model(self) -> PriorModel:
        """What produces the priors."""
        ...

    @property
    def joint(self) -> bool:
        """Whether images are better predicted in sets than alone."""
        ...

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Depth of some frames, of which only colour and camera are used.

        Raises:
            ToolkitError: a file is missing or unreadable, or the model fails.
        """
        ...


def frame_sets(count: int, size: int, stride: int) -> list[tuple[int, ...]]:
    """Sets of `size` frames at a distance of `stride` (H-14) that together contain every frame.

    `stride` sets interleave, so that all frames of a block of `size * stride` are in a set. The
    sets of the last block may be smaller.
    """
    if size < 1 or stride < 1:
        raise ValueError("the size and the stride of sets must be at least 1")
    sets = []
    for block in range(0, count, size * stride):
        end = min(block + size * stride, count)
        for first in range(block, min(block + stride, end)):
            sets.append(tuple(range(first, end, stride)))
    return sets
