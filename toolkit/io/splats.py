"""Read and write files of Gaussian splats.

Each format has its module, which reads a file into columns and writes columns (`splat_columns`). A
new format is a function and its entry in `_READERS` or `_WRITERS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.io.compressed_ply import MIP_COMMENT, write_compressed_ply
from toolkit.io.dot_splat import read_dot_splat, write_dot_splat
from toolkit.io.guarded.content import DamagedError
from toolkit.io.ksplat import read_ksplat
from toolkit.io.label_files import read_label_file, write_label_file
from toolkit.io.sog import is_filtered_sog, read_sog
from toolkit.io.sog_writing import write_sog
from toolkit.io.splat_columns import (
    CONSTANT_HARMONIC,
    OWN_COLUMNS,
    Columns,
    Order,
    SplatLike,
    check_finite,
    checked,
    columns_of,
    shapes_of,
)
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.splat_placement import SplatNotes, SplatScene
from toolkit.io.splat_plys import FILTER_COMMENT, read_ply, read_ply_comments, write_ply
from toolkit.io.splat_scenes import read_scene_notes, read_splat_scene, write_splat_scene
from toolkit.io.splat_shapes import SplatShapes
from toolkit.io.spz import SpzVersion, is_filtered_spz, read_spz, write_spz
from toolkit.io.suffixes import SCENE_SUFFIXES, SPLAT_SUFFIXES

PathLike = str | os.PathLike[str]

_PLY, _COMPRESSED_PLY, _SPZ = ".ply", ".compressed.ply", ".spz"
_READERS: dict[str, Callable[[Path], Columns]] = {
    _PLY: read_ply,
    ".splat": read_dot_splat,
    _SPZ: read_spz,
    ".sog": read_sog,
    ".ksplat": read_ksplat,
    **dict.fromkeys(SCENE_SUFFIXES, read_splat_scene),
}
# SOG that is not bundled; other files end in .json, too.
_READERS_BY_NAME = {"meta.json": read_sog}
# Formats that say whether splats were fitted with a filter of pixels, see `Splats.pixel_filter`.
_IS_FILTERED: dict[str, Callable[[Path], bool]] = {
    _SPZ: is_filtered_spz,
    ".sog": is_filtered_sog,
    ".json": is_filtered_sog,
}
# Formats with comments, which say the same.
_NOTES: dict[str, Callable[[Path], SplatNotes]] = {
    _PLY: lambda path: SplatNotes(tuple(read_ply_comments(path))),
    **dict.fromkeys(SCENE_SUFFIXES, read_scene_notes),
}
_FILTER_COMMENTS = (FILTER_COMMENT, MIP_COMMENT)
_WRITER_COMMENT = "Created by Open3D"
# Formats that quantise; the last argument is whether splats were fitted with a filter of pixels.
# They have no room for labels, which are written to a file beside them.
_WRITERS: dict[str, Callable[[Path, Columns, bool], Order]] = {
    ".splat": lambda path, columns, _: write_dot_splat(path, columns),
    _SPZ: write_spz,
    ".sog": write_sog,
    _COMPRESSED_PLY: write_compressed_ply,
}
# Suffixes of files that are read.
SUFFIXES = tuple(_READERS)
# Other formats of splats, which are not read.
FOREIGN_SUFFIXES = (".lcc", ".rad", ".splatv")


@dataclass(frozen=True)
class Splats:
    """Splats read from a file.

    Attributes:
        means: [N, 3] float32, metres.
        log_radii: [N] float32, natural logarithm of the standard deviation in metres, the mean of
            the axes' logarithms.
        opacity_logits: [N] float32.
        colours: [N, 3] float32, RGB.
        extra: additional columns [N] by name, such as `submap` (int32) or those of `labels`.
        ellipsoids: shapes and harmonics; None if all splats are isotropic and look the same from
            everywhere.
        pixel_filter: whether the file says that its ellipsoids were fitted with the filter of
            pixels of semsplat and Mip-Splatting, and not with that of 3DGS.
        taxonomy: JSON values of the class tree, from the file or from that of labels beside it.
        comments: lines of the file, such as `origin_m`, without those of the filter and Open3D.
    """

    means: NDArray[np.float32]
    log_radii: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    colours: NDArray[np.float32]
    extra: dict[str, NDArray] = field(default_factory=dict)
    ellipsoids: SplatShapes | None = None
    pixel_filter: bool = False
    taxonomy: dict[str, Any] | None = None
    comments: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.means)

    @property
    def labels(self) -> SplatLabels | None:
        """Semantic labels, or None if the file has none.

        Raises:
            FormatError: a level is missing between others.
        """
        return SplatLabels.from_columns(self.extra)


def write_splat_ply(
    path: PathLike,
    splats: SplatLike,
    extra: Mapping[str, NDArray] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Write a splat PLY atomically; the output is byte-for-byte reproducible.

    Args:
        path: the file, ending in `.ply`.
        splats: the Gaussians; colours outside [0, 1] are kept.
        extra: additional columns [N] by name, for example `SplatLabels.columns`; integers are
            stored as int32, other types as float32.
        comments: lines for the header.

    Raises:
        ValueError: a column has the wrong length, or the suffix is not `.ply`.
        RunFolderError: the file cannot be written, or there is nothing to write.
    """
    path = Path(path)
    if path.suffix != _PLY:
        raise ValueError(f"{path} must end in .ply")
    lines = [*comments, *([FILTER_COMMENT] if _is_filtered(splats) else [])]
    write_ply(path, columns_of(path, splats), extra or {}, lines)


def export_splats(
    path: PathLike,
    splats: SplatLike,
    extra: Mapping[str, NDArray] | None = None,
    comments: Sequence[str] = (),
    spz_version: SpzVersion = 4,
    taxonomy: Mapping[str, Any] | None = None,
) -> None:
    """Write splats for viewers, in the format of the suffix.

    Formats other than `.ply`, glTF and USD quantise, and store neither comments nor additional
    columns. Labels and objects in `extra`, and the class tree of a `.ply`, are written to a file
    beside them (`label_files`).

    Args:
        path: the file, ending in one of `SPLAT_SUFFIXES` or in `.compressed.ply`.
        splats: the Gaussians.
        extra: additional columns [N] by name.
        comments: lines for the header of a `.ply` and the notes of a scene.
        spz_version: version of a `.spz` file; more viewers read the versions 2 and 3 than 4.
        taxonomy: JSON values of the class tree of the labels.

    Raises:
        ValueError: the suffix is not supported.
        RunFolderError: the file cannot be written, there is nothing to write, or a value that is
            to be quantised is not a number.
    """
    path, suffix = Path(path), _written_suffix(Path(path))
    if suffix == _PLY:
        mip = [MIP_COMMENT] if _is_filtered(splats) else []
        write_splat_ply(path, splats, extra, [*comments, *mip])
        write_label_file(path, {}, taxonomy, None)
        return
    if suffix in SCENE_SUFFIXES:
        export_splat_scene(path, splats, extra, SplatScene.of_comments(comments, taxonomy))
        return
    if suffix not in _WRITERS:
        raise ValueError(f"{path} must end in one of {', '.join(SPLAT_SUFFIXES)}")
    write = partial(write_spz, version=spz_version) if suffix == _SPZ else _WRITERS[suffix]
    columns = columns_of(path, splats)
    check_finite(path, columns)
    order = write(path, columns, _is_filtered(splats))
    write_label_file(path, extra or {}, taxonomy, order)


def export_splat_scene(
    path: PathLike, splats: SplatLike, extra: Mapping[str, NDArray] | None, scene: SplatScene
) -> None:
    """Write splats as glTF or USD, depending on the suffix, with the placement of a scene.

    Raises:
        DependencyError: a package is missing.
        RunFolderError: the file cannot be written, or there is nothing to write.
    """
    if _is_filtered(splats):
        scene = replace(scene, comments=(*scene.comments, FILTER_COMMENT))
    write_splat_scene(Path(path), columns_of(Path(path), splats), extra or {}, scene)


def is_splat_file(path: PathLike) -> bool:
    """Whether a path names a splat file that can be read; False for a folder of that name.

    Raises:
        FormatError: it is a file of another format.
    """
    path = Path(path)
    if path.is_dir():
        return False
    if _reader(path) is not None:
        return True
    if path.is_file() or path.suffix.lower() in FOREIGN_SUFFIXES:
        raise FormatError(
            f"{path}: the format {path.suffix or 'of this file'} is not supported; convert it to "
            f"{', '.join(SUFFIXES)}, or give a run folder"
        )
    return False


def read_splats(path: PathLike) -> Splats:
    """Read a splat file of any of `SUFFIXES`, or the `meta.json` of a SOG that is not bundled.

    Axes are those of a `.ply`: x right, y down, z forward. Labels are read from the file or from
    beside it.

    Raises:
        DatasetError: the file is missing.
        DependencyError: the format is USD, and usd-core is missing.
        FormatError: the file is not a splat file, or is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"splat file {path} does not exist; check the path")
    read = _reader(path)
    if read is None:
        raise FormatError(f"{path} must end in one of {', '.join(SUFFIXES)}")
    # Values that are not finite are left out below.
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            columns = read(path)
    except DamagedError as error:
        raise FormatError(f"{path} cannot be read ({error}); write it again") from error
    beside = read_label_file(path, len(columns.get("positions", ())))
    if beside is not None:
        columns |= {name: column[:, None] for name, column in beside.columns.items()}
    columns = checked(path, columns)
    suffix = path.suffix.lower()
    notes = _NOTES.get(suffix, lambda _: SplatNotes())(path)
    is_filtered = _IS_FILTERED.get(
        suffix, lambda _: not set(notes.comments).isdisjoint(_FILTER_COMMENTS)
    )
    return Splats(
        means=columns["positions"].astype(np.float32),
        log_radii=np.log(columns["scale"]).mean(axis=1).astype(np.float32),
        opacity_logits=columns["opacity"][:, 0].copy(),
        colours=(0.5 + CONSTANT_HARMONIC * columns["f_dc"]).astype(np.float32),
        extra={
            name: column[:, 0].copy()
            for name, column in columns.items()
            if name not in OWN_COLUMNS and column.shape[1:] == (1,)
        },
        ellipsoids=shapes_of(path, columns),
        pixel_filter=is_filtered(path),
        taxonomy=notes.taxonomy if beside is None else beside.taxonomy,
        comments=tuple(x for x in notes.comments if x not in (*_FILTER_COMMENTS, _WRITER_COMMENT)),
    )


def _reader(path: Path) -> Callable[[Path], Columns] | None:
    return _READERS_BY_NAME.get(path.name.lower()) or _READERS.get(path.suffix.lower())


def _is_filtered(splats: SplatLike) -> bool:
    return splats.ellipsoids is not None and splats.pixel_filter


def _written_suffix(path: Path) -> str:
    return _COMPRESSED_PLY if path.name.endswith(_COMPRESSED_PLY) else path.suffix
