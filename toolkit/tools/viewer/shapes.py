"""Shapes and view-dependent colours as the viewer stores them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.io.splat_shapes import relative_covariances
from toolkit.tools.viewer.scene import HARMONIC_STEPS

# Ellipsoids that are converted at once, which bounds the memory of large maps.
_BLOCK = 500_000


class Shapes(Protocol):
    """Ellipsoids of a cloud (`Ellipsoids`, tensors) or of a file (`SplatShapes`, arrays)."""

    @property
    def log_scales(self) -> Any: ...

    @property
    def rotations(self) -> Any: ...

    @property
    def harmonics(self) -> Any: ...


def shape_columns(shapes: Shapes | None) -> dict[str, NDArray]:
    """Return the columns `shapes` and `harmonics` of `ShownSplats`, without absent ones.

    Args:
        shapes: N ellipsoids; None for spheres.
    """
    if shapes is None:
        return {}
    log_scales, rotations = np.asarray(shapes.log_scales), np.asarray(shapes.rotations)
    blocks = [slice(i, i + _BLOCK) for i in range(0, max(len(log_scales), 1), _BLOCK)]
    covariances = [relative_covariances(np.exp(log_scales[b]), rotations[b]) for b in blocks]
    columns: dict[str, NDArray] = {"shapes": np.concatenate(covariances)}
    harmonics = np.asarray(shapes.harmonics)
    if harmonics.shape[1] and harmonics.any():
        columns["harmonics"] = np.concatenate([_quantised(harmonics[b]) for b in blocks])
    return columns


def _quantised(harmonics: NDArray[np.float32]) -> NDArray[np.int8]:
    steps = np.rint(harmonics.clip(-1.0, 1.0) * HARMONIC_STEPS)
    return steps.astype(np.int8)
