"""Triangle meshes as glTF 2.0: one binary file (.glb), or JSON with an embedded buffer (.gltf).

Vertex colours are linear, not sRGB, and are shown without lighting (KHR_materials_unlit), because
they contain that of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.meshes import TriangleMesh
from toolkit.io.splat_placement import linear_from_srgb
from toolkit.io.suffixes import GLTF_SUFFIXES

_MATERIAL = {
    "name": "vertex colours",
    "doubleSided": True,
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}


@dataclass(frozen=True)
class MeshPart:
    """A part of a mesh, written as a node.

    Attributes:
        name: name of the node.
        mesh: its triangles.
        extras: JSON values stored with the node, such as the class.
    """

    name: str
    mesh: TriangleMesh
    extras: dict[str, Any] = field(default_factory=dict)


def write_gltf(
    path: Path, parts: Sequence[MeshPart], T_gltf_map: NDArray[np.float64], extras: dict[str, Any]
) -> None:
    """Write parts of a mesh as `.glb` or `.gltf`.

    Args:
        parts: nodes below one root node; at least one, with triangles.
        T_gltf_map: [4, 4] transformation of the root node to glTF's axes (y up, z forward).
        extras: JSON values stored with the root node.

    Raises:
        DependencyError: trimesh is missing.
        FormatError: the suffix is not supported.
        RunFolderError: the file cannot be written.
    """
    if path.suffix not in GLTF_SUFFIXES:
        raise FormatError(f"{path}: the name must end in {' or '.join(GLTF_SUFFIXES)}")
    try:
        import trimesh
        from trimesh.exchange.gltf import export_glb, export_gltf
    except ModuleNotFoundError as error:
        raise DependencyError(
            f"{path}: writing {path.suffix} needs {error.name}: pip install 'semsplat[exports]'"
        ) from error

    scene = trimesh.Scene()
    scene.graph.update("map", matrix=T_gltf_map, metadata=extras)
    # Names of classes need not be unique; nodes of trimesh must be.
    for key, part in enumerate(parts):
        colours: dict[str, Any] = {"color": _linear_16_bit(part.mesh.colours)}
        vertices_m, triangles = part.mesh.vertices_m, part.mesh.triangles
        mesh = trimesh.Trimesh(vertices_m, triangles, process=False, vertex_attributes=colours)
        scene.add_geometry(
            mesh, f"node {key}", f"mesh {key}", parent_node_name="map", metadata=part.extras
        )

    def finish(tree: dict[str, Any]) -> None:
        _finish(tree, parts)

    if path.suffix == ".glb":
        content = export_glb(scene, include_normals=False, tree_postprocessor=finish)
    else:
        form = {"include_normals": False, "merge_buffers": True, "embed_buffers": True}
        content = export_gltf(scene, tree_postprocessor=finish, **form)["model.gltf"]
    write_bytes(path, content)


def _finish(tree: dict[str, Any], parts: Sequence[MeshPart]) -> None:
    """Add names, the material and the meaning of the colours to a tree of trimesh."""
    tree["asset"]["generator"] = "semsplat"
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    tree["materials"] = [_MATERIAL]
    for part, node, mesh in zip(parts, tree["nodes"][1:], tree["meshes"], strict=True):
        node["name"] = mesh["name"] = part.name
        (primitive,) = mesh["primitives"]
        primitive["material"] = 0
        # trimesh writes colours with 8 bits, too few for linear ones, but attributes as they are.
        colours = primitive["attributes"].pop("_color")
        primitive["attributes"]["COLOR_0"] = colours
        tree["accessors"][colours]["normalized"] = True


def _linear_16_bit(colours: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Return linear RGBA [N, 4] of sRGB colours [N, 3] in [0, 1]."""
    linear = linear_from_srgb(colours)
    return np.rint(65535.0 * np.pad(linear, ((0, 0), (0, 1)), constant_values=1.0)).astype("<u2")
