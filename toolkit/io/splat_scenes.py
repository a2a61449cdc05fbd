"""Splats in the scene formats glTF and OpenUSD, by the suffix of the file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from numpy.typing import NDArray

from toolkit.io.gltf_splats import read_gltf_notes, read_gltf_splats, write_gltf_splats
from toolkit.io.splat_columns import Columns
from toolkit.io.splat_placement import SplatNotes, SplatScene
from toolkit.io.suffixes import USD_SUFFIXES
from toolkit.io.usd_splats import read_usd_notes, read_usd_splats, write_usd_splats


def write_splat_scene(
    path: Path, columns: Columns, extra: Mapping[str, NDArray], scene: SplatScene
) -> None:
    """Write splats as glTF or USD.

    Raises:
        DependencyError: usd-core is missing.
        RunFolderError: the file cannot be written.
    """
    write = write_usd_splats if _is_usd(path) else write_gltf_splats
    write(path, columns, extra, scene)


def read_splat_scene(path: Path) -> Columns:
    """Read the splats of a glTF or USD file, with the axes of a map.

    Raises:
        DependencyError: usd-core is missing.
        FormatError: there are no splats, or the file is damaged.
    """
    return read_usd_splats(path) if _is_usd(path) else read_gltf_splats(path)


def read_scene_notes(path: Path) -> SplatNotes:
    """Return the notes of a file of `write_splat_scene`; none for files of other programs.

    Raises:
        FormatError: the file is damaged.
    """
    return read_usd_notes(path) if _is_usd(path) else read_gltf_notes(path)


def _is_usd(path: Path) -> bool:
    return path.suffix.lower() in USD_SUFFIXES
