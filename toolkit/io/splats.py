"""Gaussian splat files (.ply, .splat, .spz) in the layout of 3DGS viewers.

Files store opacity as a logit, scale as a logarithm, rotation as a quaternion wxyz and colour as
the coefficient f_dc of the constant spherical harmonic: colour = 0.5 + 0.28209479 f_dc. Open3D
stores linear scales in memory and writes their logarithm.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError, FormatError, RunFolderError
from toolkit.geometry.open3d_bridge import open3d
from toolkit.io.atomic import replacing, write_bytes
from toolkit.io.compressed_ply import is_compressed_ply, read_compressed_ply
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.splat_shapes import SplatShapes
from toolkit.io.spz import spz_version_2

_log = logging.getLogger(__name__)

PathLike = str | os.PathLike[str]

SUFFIXES = (".ply", ".splat", ".spz")
# Other formats of splats, which are not read.
FOREIGN_SUFFIXES = (".ksplat", ".sog", ".lcc", ".rad", ".splatv", ".glb", ".gltf", ".usdz")
# A .spz file has the axes of its specification: x right, y up, z backward. Open3D does not convert
# them, neither when it reads nor when it writes.
_SPZ_AXES = np.array([1, -1, -1], np.float32)
_SPZ_MAGIC, _FIRST_UNPACKED_SPZ = b"NGSP", 4
# The value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
CONSTANT_HARMONIC = 0.28209479
# Shorter axes of splats are read as this, in metres.
_SMALLEST_M = 1e-9
# Comment in the header of a PLY; see `Splats.pixel_filter`.
_FILTER_COMMENT, _MAX_HEADER = b"pixel_filter 0.1 compensated", 8192
# Numbers of harmonics of the degrees 0 to 3, without the constant.
_HARMONICS = (0, 3, 8, 15)
# Largest logit of an opacity that is written.
_MAX_LOGIT = 40.0
# Splats with a larger ratio of the longest to the shortest axis are not isotropic.
_ISOTROPY = 1.01
_OWN_ATTRIBUTES = ("positions", "f_dc", "f_rest", "opacity", "scale", "rot", "normals")

_PLY_BYTES = {
    name: size
    for size, names in {
        1: "char uchar int8 uint8",
        2: "short ushort int16 uint16",
        4: "int uint float int32 uint32 float32",
        8: "double float64",
    }.items()
    for name in names.split()
}


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
        pixel_filter: whether the file says that its ellipsoids were fitted with semsplat's filter,
            and not with that of 3DGS.
    """

    means: NDArray[np.float32]
    log_radii: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    colours: NDArray[np.float32]
    extra: dict[str, NDArray] = field(default_factory=dict)
    ellipsoids: SplatShapes | None = None
    pixel_filter: bool = False

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
    path: PathLike, splats: SplatLike, extra: Mapping[str, NDArray] | None = None
) -> None:
    """Write a splat PLY atomically; the output is byte-for-byte reproducible.

    Args:
        path: the file, ending in `.ply`.
        splats: the Gaussians; colours outside [0, 1] are kept.
        extra: additional columns [N] by name, for example `SplatLabels.columns`; integers are
            stored as int32, other types as float32.

    Raises:
        ValueError: a column has the wrong length, or the suffix is not `.ply`.
        RunFolderError: the file cannot be written, or there is nothing to write.
    """
    if Path(path).suffix != ".ply":
        raise ValueError(f"{path} must end in .ply")
    cloud = _open3d_cloud(path, splats)
    tensor = open3d().core.Tensor
    for name, column in sorted((extra or {}).items()):
        values = np.asarray(column)
        if values.shape != (len(splats.means),):
            raise ValueError(
                f"{name} must have shape [{len(splats.means)}], got {list(values.shape)}"
            )
        dtype = np.int32 if np.issubdtype(values.dtype, np.integer) else np.float32
        cloud.point[name] = tensor(np.ascontiguousarray(values.astype(dtype)[:, None]))
    _write(path, cloud)
    if splats.ellipsoids is not None and splats.pixel_filter:
        _add_comments(Path(path), [_FILTER_COMMENT.decode()])


def export_splats(
    path: PathLike,
    splats: SplatLike,
    extra: Mapping[str, NDArray] | None = None,
    comments: Sequence[str] = (),
    spz_version: Literal[2, 4] = 4,
) -> None:
    """Write splats for viewers as `.ply`, `.splat` or `.spz`, depending on the suffix.

    `.splat` and `.spz` quantise colour, opacity and scale to about 8 bits, clamp colours to [0, 1]
    and do not support additional columns; only `.ply` stores `extra` and comments, of a line each.
    Version 2 of `.spz` is read by more viewers than version 4.

    Raises:
        ValueError: the suffix is not supported.
        RunFolderError: the file cannot be written, or there is nothing to write.
    """
    if Path(path).suffix not in SUFFIXES:
        raise ValueError(f"{path} must end in one of {', '.join(SUFFIXES)}")
    if Path(path).suffix == ".ply":
        write_splat_ply(path, splats, extra)
        if comments:
            _add_comments(Path(path), comments)
    elif Path(path).suffix == ".spz" and spz_version == 2:
        _write_spz_version_2(Path(path), splats)
    else:
        cloud = _open3d_cloud(path, splats, clamped=True)
        if Path(path).suffix == ".spz":
            _reverse_axes(cloud)
        _write(path, cloud)


def _add_comments(path: Path, comments: Sequence[str]) -> None:
    head, _, rest = path.read_bytes().partition(b"\nelement ")
    lines = "".join(f"\ncomment {line}" for line in comments).encode()
    write_bytes(path, head + lines + b"\nelement " + rest)


def _reverse_axes(cloud: Any) -> None:
    """Convert a point cloud to the axes of .spz, which Open3D does not do."""
    tensor = open3d().core.Tensor
    point = cloud.point
    harmonics = np.zeros((len(point["scale"]), 0, 3), np.float32)
    if "f_rest" in point:
        harmonics = point["f_rest"].numpy()
    shapes = SplatShapes(point["scale"].numpy(), point["rot"].numpy(), harmonics)
    reversed_shapes = shapes.with_reversed_axes()
    point["positions"] = tensor(point["positions"].numpy() * _SPZ_AXES)
    point["rot"] = tensor(reversed_shapes.rotations)
    if "f_rest" in point:
        point["f_rest"] = tensor(reversed_shapes.harmonics)


def _write_spz_version_2(path: Path, splats: SplatLike) -> None:
    if splats.ellipsoids is not None:
        raise RunFolderError(
            f"cannot write {path}: version 2 is written for isotropic splats only; use version 4"
        )
    colours = np.clip(_array(splats.colours), 0.0, 1.0)
    try:
        content = spz_version_2(
            _array(splats.means),
            _array(splats.log_radii),
            1.0 / (1.0 + np.exp(-_array(splats.opacity_logits).astype(np.float64))),
            (colours - 0.5) / CONSTANT_HARMONIC,
        )
    except ValueError as error:
        raise RunFolderError(f"cannot write {path}: {error}; write a .ply") from error
    write_bytes(path, content)


def is_splat_file(path: PathLike) -> bool:
    """Whether a path names a splat file that can be read; False for a folder of that name.

    Raises:
        FormatError: it is a file of another format.
    """
    path = Path(path)
    if path.is_dir():
        return False
    if path.suffix.lower() in SUFFIXES:
        return True
    if path.is_file() or path.suffix.lower() in FOREIGN_SUFFIXES:
        raise FormatError(
            f"{path}: the format {path.suffix or 'of this file'} is not supported; convert it to "
            f"{', '.join(SUFFIXES)}, or give a run folder"
        )
    return False


def read_splats(path: PathLike) -> Splats:
    """Read a `.ply`, `.splat` or `.spz` file; columns are found by name.

    A `.ply` may be compressed, as SuperSplat writes it. The axes of a `.spz` file are converted to
    those of `.ply`.

    Raises:
        DatasetError: the file is missing.
        FormatError: the file is not a splat file, or is truncated.
    """
    if not Path(path).is_file():
        raise DatasetError(f"splat file {path} does not exist; check the path")
    if Path(path).suffix not in SUFFIXES:
        raise FormatError(f"{path} must end in one of {', '.join(SUFFIXES)}")
    columns = _columns(Path(path))
    for name in ("positions", "f_dc", "opacity", "scale"):
        if name not in columns or len(columns[name]) == 0:
            raise FormatError(
                f"{path} is not a splat file, or is truncated: it has no {name}; write it again"
            )
    columns = _finite(path, columns)
    if Path(path).suffix == ".spz":
        columns["positions"] = columns["positions"] * _SPZ_AXES
    shapes = _shapes(path, columns)
    if shapes is not None and Path(path).suffix == ".spz":
        shapes = shapes.with_reversed_axes()
    log_scales = np.log(columns["scale"])
    # Every array is copied: if one of Open3D's own still exists at the end of the process, Open3D
    # prints statistics of its memory and changes the exit status to 1.
    return Splats(
        means=columns["positions"].astype(np.float32),
        log_radii=log_scales.mean(axis=1).astype(np.float32),
        opacity_logits=columns["opacity"][:, 0].copy(),
        colours=(0.5 + CONSTANT_HARMONIC * columns["f_dc"]).astype(np.float32),
        extra={
            name: column[:, 0].copy()
            for name, column in columns.items()
            if name not in _OWN_ATTRIBUTES and column.shape[1:] == (1,)
        },
        ellipsoids=shapes,
        pixel_filter=_is_filtered(Path(path)),
    )


def _is_filtered(path: Path) -> bool:
    if path.suffix != ".ply":
        return False
    with path.open("rb") as file:
        return _FILTER_COMMENT in file.read(_MAX_HEADER).partition(b"end_header")[0]


def _columns(path: Path) -> dict[str, NDArray]:
    """The arrays of a splat file, with Open3D's names."""
    if path.suffix == ".ply":
        if is_compressed_ply(path):
            return read_compressed_ply(path)
        _check_ply_length(path)
    if path.suffix == ".spz":
        _check_spz(path)
    try:
        point = open3d().t.io.read_point_cloud(str(path)).point
        return {name: point[name].numpy() for name in point}
    except RuntimeError as error:
        raise FormatError(
            f"{path} cannot be read ({_first_line(error)}); write it again"
        ) from error


def _finite(path: PathLike, columns: dict[str, NDArray]) -> dict[str, NDArray]:
    """The columns without the splats whose values are not numbers.

    Raises:
        FormatError: nothing is left.
    """
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


def _shapes(path: PathLike, columns: Mapping[str, NDArray]) -> SplatShapes | None:
    """The shapes of splats that are anisotropic or depend on the view, as in the file's axes."""
    if "rot" not in columns:
        return None
    count, log_scales = len(columns["scale"]), np.log(columns["scale"])
    harmonics = columns.get("f_rest", np.zeros((count, 0, 3)))
    if harmonics.shape[1] not in _HARMONICS:
        raise FormatError(
            f"{path} has {harmonics.shape[1]} harmonics per colour, instead of "
            f"{', '.join(map(str, _HARMONICS[:-1]))} or {_HARMONICS[-1]}; write it again"
        )
    if not harmonics.any() and (np.ptp(log_scales, axis=1) <= np.log(_ISOTROPY)).all():
        return None
    rotations = columns["rot"].astype(np.float32)
    rotations[~(np.linalg.norm(rotations, axis=1) > 0)] = (1, 0, 0, 0)
    return SplatShapes(log_scales.astype(np.float32), rotations, harmonics.astype(np.float32))


def _check_spz(path: Path) -> None:
    """Check the version of a `.spz` file, which Open3D reports on the terminal only.

    Raises:
        FormatError: it is not a `.spz` file, or its version is not supported.
    """
    with path.open("rb") as stream:
        head = stream.read(16)
    is_packed = head[:2] == b"\x1f\x8b"
    if not is_packed and head[:4] != _SPZ_MAGIC:
        raise FormatError(f"{path} is not a .spz file; write it again")
    version = int.from_bytes(head[4:8], "little")
    if not is_packed and version < _FIRST_UNPACKED_SPZ:
        raise FormatError(
            f"{path}: a .spz file of version {version} must be compressed with gzip; write it "
            "again, or convert it to .ply"
        )


def _open3d_cloud(path: PathLike, splats: SplatLike, clamped: bool = False) -> Any:
    """Convert splats to an Open3D tensor point cloud."""
    means = _array(splats.means)
    if len(means) == 0:
        raise RunFolderError(f"cannot write {path}: the map contains no Gaussians")
    o3d = open3d()
    scales_m = np.repeat(np.exp(_array(splats.log_radii))[:, None], 3, axis=1)
    colours = _array(splats.colours)
    if clamped:
        colours = np.clip(colours, 0.0, 1.0)
    rotations = np.zeros((len(means), 4), np.float32)
    rotations[:, 0] = 1.0
    shapes, harmonics = splats.ellipsoids, {}
    if shapes is not None:
        scales_m, rotations = np.exp(_array(shapes.log_scales)), _array(shapes.rotations)
        rotations = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
        if shapes.harmonics.shape[1]:
            harmonics["f_rest"] = _array(shapes.harmonics)
    attributes = {
        "positions": means,
        "f_dc": (colours - np.float32(0.5)) / np.float32(CONSTANT_HARMONIC),
        # PLY files of RPly contain no infinite values; the sigmoid is the same.
        "opacity": np.clip(_array(splats.opacity_logits), -_MAX_LOGIT, _MAX_LOGIT)[:, None],
        "scale": scales_m,
        "rot": rotations,
        **harmonics,
    }
    cloud = o3d.t.geometry.PointCloud()
    for name, values in attributes.items():
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))
    return cloud


def _write(path: PathLike, cloud: Any) -> None:
    with replacing(path) as temporary:
        if not open3d().t.io.write_point_cloud(str(temporary), cloud):
            raise RunFolderError(f"cannot write {path}: free space there, or allow writing")


def _array(values: Any) -> NDArray[np.float32]:
    """Convert an array, or a tensor on any device, to a float32 array."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float32)


def _check_ply_length(path: Path) -> None:
    """Check that a binary PLY has the length given by its header, which Open3D does not check.

    Raises:
        FormatError: the file is shorter.
    """
    content = path.read_bytes()
    if not content.startswith(b"ply"):
        raise FormatError(f"{path} is not a PLY file; write it again")
    header, end, body = content.partition(b"end_header\n")
    words = [line.split() for line in header.decode("latin-1").splitlines()]
    if not end or ["format", "binary_little_endian", "1.0"] not in words:
        return
    expected, count = 0, 0
    for line in words:
        if line[:1] == ["element"]:
            count = int(line[2])
        elif line[:1] == ["property"] and line[1] in _PLY_BYTES:
            expected += count * _PLY_BYTES[line[1]]
    if len(body) < expected:
        raise FormatError(
            f"{path} is truncated: {len(body)} of {expected} bytes of data; write it again"
        )


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
