"""Placement of splats in scenes, whose axes and colour spaces differ from those of a map."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.harmonics import harmonic_rotation
from toolkit.io.length_names import LengthNames
from toolkit.io.splat_columns import CONSTANT_HARMONIC, Columns, harmonics_of
from toolkit.io.splat_shapes import SplatShapes

_log = logging.getLogger(__name__)

# From the axes of a map (y down, z forward) to those of glTF and USD (y up, z backward), or back.
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
# Maximum relative difference of the axes of a transformation that scales uniformly.
_SIMILARITY = 1e-4
# Entries of transformations closer to an integer are that integer, so that axes are exact.
_ROUNDING = 1e-9
_ORIGIN = "origin_m "


@dataclass(frozen=True)
class SplatNotes:
    """Notes that are read from a file of splats.

    Attributes:
        comments: one line each, such as `origin_m`.
        taxonomy: JSON values of the class tree of the labels, or None.
    """

    comments: tuple[str, ...] = ()
    taxonomy: dict[str, Any] | None = None


@dataclass(frozen=True)
class SplatScene:
    """What a scene file contains besides splats.

    Attributes:
        T_scene_map: [4, 4] rotation and translation from the map to the axes of the scene: x right,
            y up, z backward.
        metric: whether lengths are metres.
        comments: one line each, such as `origin_m`.
        taxonomy: JSON values of the class tree of the labels (`Taxonomy.to_json`), or None.
    """

    T_scene_map: NDArray[np.float64] = field(default_factory=HALF_TURN.copy)
    metric: bool = True
    comments: tuple[str, ...] = ()
    taxonomy: Mapping[str, Any] | None = None

    @classmethod
    def of_comments(
        cls, comments: Sequence[str], taxonomy: Mapping[str, Any] | None = None
    ) -> SplatScene:
        """A scene with the axes of the map, placed and scaled as comments of the map say."""
        T_scene_map = HALF_TURN @ se3.from_rotation_translation(np.eye(3), origin_in(comments))
        metric = LengthNames.of_comments(comments).metric
        return cls(T_scene_map, metric, tuple(comments), taxonomy)

    @property
    def classes(self) -> dict[str, str]:
        """Names of the labels by class id, which is text as in JSON."""
        names = () if self.taxonomy is None else self.taxonomy["classes"]
        return {str(class_id): name for class_id, name in enumerate(names, start=1)}

    @property
    def T_scene_file(self) -> NDArray[np.float64]:
        """Transformation [4, 4] of the node: splats are stored after a half turn about x.

        So they are nearly upright for programs that ignore transformations. Without a known floor,
        there is no transformation, and harmonics are exact in programs that do not rotate them.
        """
        return self.T_scene_map @ HALF_TURN


def origin_comment(origin_m: NDArray[np.float64]) -> list[str]:
    """The origin [3] of a map, in the coordinates of given poses, as a comment; none if it is 0."""
    return [f"{_ORIGIN}{{:.3f}} {{:.3f}} {{:.3f}}".format(*origin_m)] if origin_m.any() else []


def origin_in(comments: Sequence[str]) -> NDArray[np.float64]:
    """The origin [3] that a comment of `origin_comment` contains; 0 without one."""
    for line in comments:
        words = line.removeprefix(_ORIGIN).split()
        if line.startswith(_ORIGIN) and len(words) == 3:
            try:
                origin_m = np.array(words, np.float64)
            except ValueError:
                continue
            if np.isfinite(origin_m).all():
                return origin_m
    return np.zeros(3)


def linear_from_srgb(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return linear values of sRGB values, clipped to [0, 1]."""
    values = np.clip(values.astype(np.float64), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def constant_colours(columns: Columns) -> NDArray[np.float64]:
    """Return the part [N, 3] of the colours that does not depend on the view."""
    return 0.5 + CONSTANT_HARMONIC * columns["f_dc"].astype(np.float64)


def in_srgb(path: Path, columns: Columns, colour_space: str) -> Columns:
    """Convert colours to sRGB, in which splats are blended here.

    Splats of linear colours are converted one by one: their constant colour exactly, harmonics to
    first order. Overlapping transparent splats look slightly different.
    """
    if colour_space.startswith("srgb_rec709"):
        return columns
    if not colour_space.startswith("lin_rec709"):
        _log.warning("%s: colour space %r is unknown; it is read as sRGB.", path, colour_space)
        return columns
    _log.warning("%s: linear colours are converted to sRGB splat by splat.", path)
    linear = np.clip(constant_colours(columns), 0.0, 1.0)
    bright = linear > 0.0031308
    power = np.maximum(linear, 0.0031308)
    colours = np.where(bright, 1.055 * power ** (1 / 2.4) - 0.055, 12.92 * linear)
    slopes = np.where(bright, 1.055 / 2.4 * power ** (1 / 2.4 - 1.0), 12.92)
    converted = dict(columns)
    converted["f_dc"] = ((colours - 0.5) / CONSTANT_HARMONIC).astype(np.float32)
    if "f_rest" in columns:
        converted["f_rest"] = (columns["f_rest"] * slopes[:, None]).astype(np.float32)
    return converted


def placed(path: Path, columns: Columns, T: NDArray[np.float64]) -> Columns:
    """Return the columns after a transformation [4, 4]: a similarity, also of the view dependence.

    Raises:
        FormatError: it is no rotation, translation and uniform positive scale.
    """
    scale, R = _similarity(path, T)
    shift = _rounded(T[:3, 3])
    shapes = SplatShapes(columns["scale"], columns["rot"], harmonics_of(columns))
    moved = dict(columns)
    positions = columns["positions"].astype(np.float64) @ (scale * R).T + shift
    moved["positions"] = positions.astype(np.float32)
    moved["scale"] = (columns["scale"] * scale).astype(np.float32)
    if np.array_equal(R, HALF_TURN[:3, :3]):
        shapes = shapes.with_reversed_axes()
    elif not np.array_equal(R, np.eye(3)):
        shapes = _turned(shapes, R)
    moved["rot"] = shapes.rotations.astype(np.float32)
    if "f_rest" in columns:
        moved["f_rest"] = shapes.harmonics.astype(np.float32)
    return moved


def _similarity(path: Path, T: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """The scale and the rotation [3, 3] of a transformation."""
    if np.isfinite(T).all():
        scale = _rounded(np.linalg.norm(T[:3, :3], axis=0).mean())
        R = _rounded(T[:3, :3] / max(float(scale), np.finfo(float).tiny))
        if np.abs(R.T @ R - np.eye(3)).max() < _SIMILARITY and np.linalg.det(R) > 0:
            return float(scale), R
    raise FormatError(
        f"{path}: splats are placed by a transformation that is mirrored, skewed or scaled "
        "differently along its axes; apply it to the splats, and write the file again"
    )


def _rounded(values: Any) -> NDArray[np.float64]:
    whole = np.rint(values)
    return np.where(np.abs(values - whole) < _ROUNDING, whole, values)


def _turned(shapes: SplatShapes, R: NDArray[np.float64]) -> SplatShapes:
    x, y, z, w = se3.quaternion_xyzw(R)
    product = np.array(((w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w)))
    matrix = harmonic_rotation(R, shapes.harmonics.shape[1])
    return SplatShapes(
        shapes.log_scales,
        shapes.rotations @ product.T,
        np.einsum("jk,nkc->njc", matrix, shapes.harmonics),
    )


def concatenated(parts: Sequence[Columns]) -> Columns:
    """Concatenate splats, with the highest degree of harmonics and the columns of all parts."""
    if len(parts) == 1:
        return dict(parts[0])
    K = max(part["f_rest"].shape[1] if "f_rest" in part else 0 for part in parts)
    filled = []
    for part in parts:
        harmonics = np.zeros((len(part["positions"]), K, 3), np.float32)
        if "f_rest" in part:
            harmonics[:, : part["f_rest"].shape[1]] = part["f_rest"]
        filled.append({**part, "f_rest": harmonics})
    names = [name for name in filled[0] if all(name in part for part in filled)]
    return {name: np.concatenate([part[name] for part in filled]) for name in names}
