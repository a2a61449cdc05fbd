"""Gaussian splats as glTF 2.0 with the extension KHR_gaussian_splatting (`.glb`, `.gltf`).

Source: the specification of the extension, ratified by the Khronos Group. Splats are a primitive of
points with linear scales, opacities in [0, 1], quaternions xyzw, and harmonics as in files of 3DGS.
Labels and other columns are attributes with an underscore, such as `_LABEL_L0`; their class tree is
in the extras of the asset. The file is written directly: trimesh, which writes our meshes, has no
points with attributes of their own.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.io.gltf_document import (
    DAMAGED,
    GltfDocument,
    entry,
    read_document,
    write_document,
)
from toolkit.io.splat_columns import OWN_COLUMNS, Columns, logits, opacities_of
from toolkit.io.splat_placement import (
    HALF_TURN,
    SplatNotes,
    SplatScene,
    concatenated,
    constant_colours,
    in_srgb,
    linear_from_srgb,
    placed,
)

_log = logging.getLogger(__name__)

_EXTENSION = "KHR_gaussian_splatting"
# Extensions that a file may require.
_SUPPORTED = (_EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit")
_PREFIX = _EXTENSION + ":"
_DESCRIPTION = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
_POINTS, _ARRAY_BUFFER = 0, 34962
_COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "float32": 5126}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
# Vertex attributes start at multiples of this.
_ALIGNMENT = 4


def write_gltf_splats(
    path: Path, columns: Columns, extra: Mapping[str, NDArray], scene: SplatScene
) -> None:
    """Write splats as `.glb`, or as `.gltf` with an embedded buffer.

    Args:
        columns: the splats in the frame of the map; see `splat_columns`.
        extra: additional columns [N] by name; integers within 16 bits, other types as float32.
        scene: placement, class tree and comments.

    Raises:
        RunFolderError: the file cannot be written, or a column has larger integers.
    """
    columns = placed(path, columns, HALF_TURN)
    attributes = _attributes(columns)
    for name, values in sorted(extra.items()):
        attributes["_" + name.upper()] = _attribute_column(path, name, values)
    tree, binary = _buffered(attributes)
    T = scene.T_scene_file
    matrix = {} if np.array_equal(T, np.eye(4)) else {"matrix": T.T.ravel().tolist()}
    extras = {"T_gltf_map": scene.T_scene_map.tolist(), "metric": scene.metric}
    notes = {
        "comments": list(scene.comments),
        "classes": scene.classes,
        "taxonomy": scene.taxonomy,
    }
    description = {
        "asset": {
            "version": "2.0",
            "generator": "semsplat",
            "extras": {name: values for name, values in notes.items() if values},
        },
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0, **matrix, "extras": extras}],
    }
    write_document(path, {**description, **tree}, binary)


def _attributes(columns: Columns) -> dict[str, NDArray]:
    """The vertex attributes of the specification, by name."""
    rotations = columns["rot"] / np.linalg.norm(columns["rot"], axis=1, keepdims=True)
    alpha = opacities_of(columns)[:, None]
    # The fallback of programs that show points only; linear, as glTF demands.
    shown = np.hstack([linear_from_srgb(constant_colours(columns)), alpha])
    attributes = {
        "POSITION": columns["positions"],
        "COLOR_0": np.rint(65535.0 * shown).astype(np.uint16),
        _PREFIX + "ROTATION": np.roll(rotations, -1, axis=1),
        _PREFIX + "SCALE": columns["scale"],
        _PREFIX + "OPACITY": alpha,
        _PREFIX + "SH_DEGREE_0_COEF_0": columns["f_dc"],
    }
    harmonics = columns.get("f_rest", np.zeros((len(alpha), 0, 3)))
    for k, name in enumerate(_harmonic_names(harmonics.shape[1])):
        attributes[name] = harmonics[:, k]
    return {
        name: values if values.dtype == np.uint16 else values.astype(np.float32)
        for name, values in attributes.items()
    }


def _harmonic_names(count: int) -> list[str]:
    """The attributes of the first `count` harmonics after the constant."""
    places = [(degree, n) for degree in (1, 2, 3) for n in range(2 * degree + 1)]
    return [f"{_PREFIX}SH_DEGREE_{degree}_COEF_{n}" for degree, n in places[:count]]


def _attribute_column(path: Path, name: str, values: NDArray) -> NDArray:
    """A column [N, 1] with a type that glTF allows for attributes of applications."""
    if not np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32)[:, None]
    for dtype in (np.int16, np.uint16):
        limits = np.iinfo(dtype)
        if limits.min <= values.min() and values.max() <= limits.max:
            return values.astype(dtype)[:, None]
    raise RunFolderError(
        f"cannot write {path}: the column {name} has integers of more than 16 bits; write a .ply"
    )


def _buffered(attributes: Mapping[str, NDArray]) -> tuple[dict[str, Any], bytes]:
    """The tree of a mesh, and the buffer with its attributes."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    parts, place = [], 0
    for name, values in attributes.items():
        width = values.itemsize * values.shape[1]
        stride = -(-width // _ALIGNMENT) * _ALIGNMENT
        rows = np.zeros((len(values), stride), np.uint8)
        rows[:, :width] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), width)
        view = {"buffer": 0, "byteOffset": place, "byteLength": rows.size, "target": _ARRAY_BUFFER}
        views.append(view if stride == width else {**view, "byteStride": stride})
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": _COMPONENTS[values.dtype.name],
                "count": len(values),
                "type": _TYPES[values.shape[1]],
                **({"normalized": True} if name == "COLOR_0" else {}),
                **(_limits(values) if name == "POSITION" else {}),
            }
        )
        parts.append(rows.tobytes())
        place += rows.size
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: _DESCRIPTION},
    }
    tree = {
        "meshes": [{"name": "splats", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": place}],
    }
    return tree, b"".join(parts)


def _limits(values: NDArray) -> dict[str, list[float]]:
    return {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}


def read_gltf_splats(path: Path) -> Columns:
    """Read the splats of a scene; see `splat_columns` for the columns.

    Files of `write_gltf_splats` are returned in the frame of their map, other files with the axes
    of a map: y down, z forward.

    Raises:
        FormatError: there are no splats, the file is damaged, or something is not supported.
    """
    document = read_document(path)
    try:
        _check_required(document)
        parts = [
            placed(path, _primitive(document, primitive), _T_map_scene(nodes) @ T_scene_node)
            for T_scene_node, nodes in document.mesh_nodes()
            for primitive in entry(document.tree["meshes"], nodes[-1]["mesh"])["primitives"]
            if _EXTENSION in primitive.get("extensions", {})
        ]
    except DAMAGED as error:
        raise FormatError(f"{path}: the glTF is damaged ({error!r}); write it again") from error
    if not parts:
        raise FormatError(
            f"{path} contains no splats ({_EXTENSION}); export them with semsplat export "
            "--format splats"
        )
    return concatenated(parts)


def read_gltf_notes(path: Path) -> SplatNotes:
    """Return the notes of a file of `write_gltf_splats`; none for other files."""
    extras = read_document(path).tree["asset"].get("extras")
    if not isinstance(extras, dict):
        return SplatNotes()
    comments, taxonomy = extras.get("comments"), extras.get("taxonomy")
    return SplatNotes(
        tuple(map(str, comments)) if isinstance(comments, list) else (),
        taxonomy if isinstance(taxonomy, dict) else None,
    )


def _check_required(document: GltfDocument) -> None:
    missing = [
        name for name in document.tree.get("extensionsRequired", []) if name not in _SUPPORTED
    ]
    if missing:
        raise FormatError(
            f"{document.path} requires the extension {missing[0]}, which is not supported; write "
            "the file without it"
        )


def _T_map_scene(nodes: Sequence[dict[str, Any]]) -> NDArray[np.float64]:
    """The transformation [4, 4] from the scene to the map: that of our own files, or the axes."""
    for node in reversed(nodes):
        extras = node.get("extras")
        if isinstance(extras, dict) and "T_gltf_map" in extras:
            T_gltf_map = np.array(extras["T_gltf_map"], np.float64).reshape(4, 4)
            return np.asarray(np.linalg.inv(T_gltf_map))
    return HALF_TURN


def _primitive(document: GltfDocument, primitive: dict[str, Any]) -> Columns:
    """The splats of a primitive, with the axes of the file."""
    path, attributes = document.path, primitive["attributes"]
    description = primitive["extensions"][_EXTENSION]
    if description.get("kernel", "ellipse") != "ellipse":
        kernel = description["kernel"]
        _log.warning("%s: kernel %r is unknown; splats are read as ellipsoids.", path, kernel)
    if primitive.get("mode") != _POINTS:
        raise FormatError(f"{path}: splats must be points (mode 0); write the file again")
    count = len(_values(document, attributes, "POSITION", 3))

    def values(name: str, width: int) -> NDArray:
        return _values(document, attributes, name, width, count)

    scale = values(_PREFIX + "SCALE", 3).astype(np.float64)
    columns = {
        "positions": values("POSITION", 3),
        "rot": np.roll(values(_PREFIX + "ROTATION", 4).astype(np.float64), 1, axis=1),
        # Negative scales are not valid.
        "scale": np.where(scale < 0, np.nan, scale),
        "opacity": logits(values(_PREFIX + "OPACITY", 1)[:, 0]),
        "f_dc": values(_PREFIX + "SH_DEGREE_0_COEF_0", 3).astype(np.float32),
    }
    names = _harmonic_names(15)
    degree = max((d for d in (1, 2, 3) if names[d * d - 1] in attributes), default=0)
    if degree:
        harmonics = [values(name, 3) for name in names[: (degree + 1) ** 2 - 1]]
        columns["f_rest"] = np.stack(harmonics, axis=1).astype(np.float32)
    for name in _scalars(document, attributes):
        column = values(name, 1)
        is_integer = np.issubdtype(column.dtype, np.integer)
        columns[name[1:].lower()] = column.astype(np.int32 if is_integer else np.float32)
    return in_srgb(path, columns, description.get("colorSpace", _DESCRIPTION["colorSpace"]))


def _values(
    document: GltfDocument,
    attributes: Mapping[str, int],
    name: str,
    width: int,
    count: int | None = None,
) -> NDArray:
    """The values [N, width] of an attribute, of `count` splats if it is known."""
    if name not in attributes:
        raise FormatError(
            f"{document.path}: the splats have no attribute {name}; write the file again"
        )
    values = document.accessor(attributes[name])
    expected = (len(values) if count is None else count, width)
    if values.shape != expected:
        raise FormatError(
            f"{document.path}: attribute {name} has shape {list(values.shape)}, instead of "
            f"{list(expected)}; write the file again"
        )
    return values


def _scalars(document: GltfDocument, attributes: Mapping[str, int]) -> list[str]:
    """The attributes of applications with one number for each splat."""
    return [
        name
        for name, index in attributes.items()
        if name.startswith("_")
        and name[1:].lower() not in OWN_COLUMNS
        and entry(document.tree["accessors"], index)["type"] == "SCALAR"
    ]
