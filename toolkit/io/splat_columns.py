"""The values of splats in columns, the form that all splat files are read into and written from.

Columns have the names of Open3D: `positions` [N, 3] in metres (x right, y down, z forward), `scale`
[N, 3] standard deviations in metres, `rot` [N, 4] quaternions wxyz, `opacity` [N, 1] as a logit,
`f_dc` [N, 3] constant spherical harmonics (colour = 0.5 + 0.28209479 f_dc) and, for colours that
depend on the view, `f_rest` [N, K, 3] with K of 3, 8 or 15. Additional columns are [N, 1].
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.splat_shapes import SplatShapes

_log = logging.getLogger(__name__)

Columns = dict[str, NDArray]
# Rows of a file, as indices of what was to be written; None if it keeps their order.
Order = NDArray[np.int64] | None

# The value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
CONSTANT_HARMONIC = 0.28209479
OWN_COLUMNS = ("positions", "f_dc", "f_rest", "opacity", "scale", "rot", "normals")
# Opacities of 0 and 1 have no finite logit.
_SMALLEST_OPACITY = 2.0**-24
# Largest logit of an opacity that is written.
_MAX_LOGIT = 40.0
# Shorter axes of splats are read as this, in metres.
_SMALLEST_M = 1e-9
# Files of that many splats do not need much memory.
_UNCHECKED_COUNT = 2**20
# Splats with a larger ratio of the longest to the shortest axis are not isotropic.
_ISOTROPY = 1.01


class SplatLike(Protocol):
    """Gaussians that can be written: `GaussianCloud` (tensors) or `Splats` (arrays)."""

    @property
    def means(self) -> Any: ...

    @property
    def log_radii(self) -> Any: ...

    @property
    def opacity_logits(self) -> Any: ...

    @property
    def colours(self) -> Any: ...

    @property
    def ellipsoids(self) -> Any: ...

    @property
    def pixel_filter(self) -> bool: ...


def columns_of(path: Path, splats: SplatLike) -> Columns:
    """The columns of splats that are written to a file, in float32 with rotations of length 1.

    Raises:
        RunFolderError: there are none.
    """
    means = _array(splats.means)
    if len(means) == 0:
        raise RunFolderError(f"cannot write {path}: the map contains no Gaussians")
    shapes = splats.ellipsoids
    if shapes is None:
        scales_m = np.repeat(np.exp(_array(splats.log_radii))[:, None], 3, axis=1)
        rotations = np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1))
    else:
        scales_m, rotations = np.exp(_array(shapes.log_scales)), _array(shapes.rotations)
        rotations = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
    columns = {
        "positions": means,
        "f_dc": (_array(splats.colours) - np.float32(0.5)) / np.float32(CONSTANT_HARMONIC),
        # RPly skips infinite values; the sigmoid is the same.
        "opacity": np.clip(_array(splats.opacity_logits), -_MAX_LOGIT, _MAX_LOGIT)[:, None],
        "scale": scales_m,
        "rot": rotations,
    }
    if shapes is not None and shapes.harmonics.shape[1]:
        columns["f_rest"] = _array(shapes.harmonics)
    return {name: np.ascontiguousarray(c, np.float32) for name, c in columns.items()}


def harmonics_of(columns: Columns) -> NDArray[np.float32]:
    """The harmonics [N, K, 3]; K is 0 if the colours do not depend on the view."""
    return columns.get("f_rest", np.zeros((len(columns["positions"]), 0, 3), np.float32))


def with_reversed_axes(columns: Columns) -> Columns:
    """The columns after a half turn about the x axis: y up and z backward, or back again."""
    shapes = SplatShapes(columns["scale"], columns["rot"], harmonics_of(columns))
    turned = shapes.with_reversed_axes()
    positions = columns["positions"] * np.array([1, -1, -1], np.float32)
    reversed_ = columns | {"positions": positions, "rot": turned.rotations}
    return reversed_ | {"f_rest": turned.harmonics} if "f_rest" in columns else reversed_


def opacities_of(columns: Columns) -> NDArray[np.float64]:
    """The opacities [N] in [0, 1]."""
    with np.errstate(over="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp(-columns["opacity"][:, 0].astype(np.float64))))


def logits(opacities: NDArray[np.floating]) -> NDArray[np.float32]:
    """The column `opacity` [N, 1] of opacities [N] in [0, 1]."""
    inside = np.clip(opacities, _SMALLEST_OPACITY, 1.0 - _SMALLEST_OPACITY)
    return np.log(inside / (1.0 - inside)).astype(np.float32)[:, None]


def check_finite(path: Path, columns: Columns) -> None:
    """Check that values can be quantised: one that is not a number would spoil the range of all.

    Raises:
        RunFolderError: one is not finite.
    """
    finite = columns | {"opacity": opacities_of(columns)}
    if not all(np.isfinite(column).all() for column in finite.values()):
        raise RunFolderError(
            f"cannot write {path}: the map contains Gaussians that are not finite; write a .ply"
        )


def check_count(path: Path, count: int, size: int) -> None:
    """Check that a compressed file may contain as many splats as it announces.

    Args:
        path: the file.
        count: the number of splats that it announces.
        size: the number of its bytes.

    Raises:
        FormatError: there are none, or so many that a splat has less than a byte. Such a file would
            take a multiple of its size in memory; those of real maps have at least 10.
    """
    if not 1 <= count <= max(size, _UNCHECKED_COUNT):
        raise FormatError(
            f"{path} is damaged: it announces {count} splats in {size} bytes; write it again"
        )


def checked(path: Path, columns: Columns) -> Columns:
    """The columns of a file without the splats whose values are not numbers.

    Raises:
        FormatError: a column is missing, or nothing is left.
    """
    for name in ("positions", "f_dc", "opacity", "scale", "rot"):
        if name not in columns:
            raise FormatError(f"{path} is not a splat file: it has no {name}; write it again")
    if len(columns["positions"]) == 0:
        raise FormatError(f"{path} contains no splats; write it again")
    # An axis of length 0 is that of a disc; an infinite logit is an opacity of 0 or 1.
    columns = columns | {"scale": np.maximum(columns["scale"], _SMALLEST_M)}
    good = ~np.isnan(columns["opacity"][:, 0])
    for name in ("positions", "f_dc", "scale", "rot", "f_rest"):
        if name in columns:
            good &= np.isfinite(columns[name].reshape(len(good), -1)).all(axis=1)
    if good.all():
        return columns
    if not good.any():
        raise FormatError(f"{path} contains no splat with finite values; write it again")
    count = int((~good).sum())
    _log.warning("%s: %d of %d splats are not finite and left out.", path, count, len(good))
    return {name: column[good] for name, column in columns.items()}


def shapes_of(path: Path, columns: Mapping[str, NDArray]) -> SplatShapes | None:
    """The shapes of splats that are anisotropic or depend on the view; None if none does.

    Raises:
        FormatError: the number of harmonics is not that of a degree.
    """
    count, log_scales = len(columns["scale"]), np.log(columns["scale"])
    harmonics = columns.get("f_rest", np.zeros((count, 0, 3)))
    if harmonics.shape[1] not in HARMONIC_COUNTS:
        raise FormatError(
            f"{path} has {harmonics.shape[1]} harmonics per colour, instead of "
            f"{', '.join(map(str, HARMONIC_COUNTS[:-1]))} or {HARMONIC_COUNTS[-1]}; write it again"
        )
    if not harmonics.any() and (np.ptp(log_scales, axis=1) <= np.log(_ISOTROPY)).all():
        return None
    # In double precision, no square overflows or becomes 0.
    rotations = columns["rot"].astype(np.float64)
    lengths = np.linalg.norm(rotations, axis=1, keepdims=True)
    rotations = np.where(lengths > 0, rotations / np.maximum(lengths, 1e-60), (1.0, 0, 0, 0))
    values = (log_scales, rotations, harmonics)
    return SplatShapes(*(value.astype(np.float32) for value in values))


def _array(values: Any) -> NDArray[np.float32]:
    """Convert an array, or a tensor on any device, to a float32 array."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float32)
