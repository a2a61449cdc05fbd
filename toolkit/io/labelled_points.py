"""Point clouds with colours, classes and confidences: PLY, and LAS or LAZ through laspy.

The class names are stored in the file: in a PLY as comments `class ID NAME`, in LAS and LAZ as JSON
in a variable length record (user `semsplat`, record 1).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, FormatError
from toolkit.io.atomic import replacing, write_bytes
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.suffixes import LABELLED_SUFFIXES

LAS_USER, LAS_RECORD = "semsplat", 1

# LAS stores coordinates as multiples of this length.
_LAS_STEP_M = 0.0001
# Point format of LAS 1.4 with colours; its classification has 8 bits, of which 64 to 255 are free.
_POINT_FORMAT, _FIRST_FREE_CODE, _LAST_CODE = 7, 64, 255
_UNCLASSIFIED = 1
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
# Coordinates beyond this lose more than 0.1 mm in single precision.
_MAX_SINGLE_M = 1000.0


@dataclass(frozen=True)
class LabelledPoints:
    """Points with colours and, if known, classes.

    Attributes:
        points_m: [N, 3] float, metres.
        rgb: [N, 3] uint8.
        labels: labels of the points, or None.
        classes: class names by id, from 1.
    """

    points_m: NDArray[np.floating]
    rgb: NDArray[np.uint8]
    labels: SplatLabels | None
    classes: Mapping[int, str]

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def columns(self) -> dict[str, NDArray]:
        """Columns of the labels by name, without those of colour and position."""
        return {} if self.labels is None else self.labels.columns()


def write_labelled_points(path: Path, points: LabelledPoints) -> None:
    """Write points as `.ply`, `.las` or `.laz`, depending on the suffix.

    Raises:
        DependencyError: laspy is missing.
        FormatError: the suffix is not supported, or a class name contains a line break.
        RunFolderError: the file cannot be written.
    """
    if path.suffix == ".ply":
        _write_ply(path, points)
    elif path.suffix in LABELLED_SUFFIXES:
        _write_las(path, points)
    else:
        raise FormatError(f"{path}: the name must end in {' or '.join(LABELLED_SUFFIXES)}")


def _write_ply(path: Path, points: LabelledPoints) -> None:
    far = len(points) > 0 and float(np.abs(points.points_m).max()) > _MAX_SINGLE_M
    fields: list[tuple[str, str]] = [(axis, "f8" if far else "f4") for axis in "xyz"]
    fields += [(colour, "u1") for colour in ("red", "green", "blue")]
    fields += [
        (name, "i4" if np.issubdtype(column.dtype, np.integer) else "f4")
        for name, column in points.columns.items()
    ]
    rows = np.empty(len(points), [(name, f"<{kind}") for name, kind in fields])
    for k, axis in enumerate("xyz"):
        rows[axis] = points.points_m[:, k]
    for k, colour in enumerate(("red", "green", "blue")):
        rows[colour] = points.rgb[:, k]
    for name, column in points.columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment class {number} {name}" for number, name in _names(path, points)]
    header += [f"element vertex {len(points)}"]
    header += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in fields]
    write_bytes(path, ("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes())


def _names(path: Path, points: LabelledPoints) -> Sequence[tuple[int, str]]:
    for name in points.classes.values():
        if len(name.splitlines()) != 1:
            raise FormatError(f"cannot write {path}: the class name {name!r} has a line break")
    return sorted(points.classes.items())


def _write_las(path: Path, points: LabelledPoints) -> None:
    laspy = _laspy(path)
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.offsets = np.floor(points.points_m.min(axis=0)) if len(points) else np.zeros(3)
    header.scales = np.full(3, _LAS_STEP_M)
    for name, column in points.columns.items():
        kind = np.int32 if np.issubdtype(column.dtype, np.integer) else np.float32
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind))
    if points.classes:
        names = json.dumps({str(number): name for number, name in _names(path, points)})
        header.vlrs.append(laspy.VLR(LAS_USER, LAS_RECORD, "class names", names.encode()))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.points_m.astype(np.float64).T
    # LAS has 16 bits per colour; 255 becomes 65535.
    las.red, las.green, las.blue = points.rgb.astype(np.uint16).T * np.uint16(257)
    for name, column in points.columns.items():
        las[name] = column
    if points.labels is not None:
        las.classification = las_codes(points.labels.label)
    with replacing(path) as temporary:
        las.write(str(temporary))


def las_codes(label: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Return the classification codes [N] of class ids: 63 + id in the range free for users.

    Void and ids without a free code become 1, unclassified; the column `label` has all ids.
    """
    codes = label + (_FIRST_FREE_CODE - 1)
    known = (label > 0) & (codes <= _LAST_CODE)
    return np.where(known, codes, _UNCLASSIFIED).astype(np.uint8)


def _laspy(path: Path) -> Any:
    try:
        import laspy
        import lazrs  # noqa: F401  (used by laspy for .laz)
    except ImportError as error:
        raise DependencyError(
            f"{path}: writing {path.suffix} needs laspy; install it with: "
            "pip install 'semsplat[exports]'"
        ) from error
    return laspy
