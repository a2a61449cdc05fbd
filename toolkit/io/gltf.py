"""Triangle meshes as glTF 2.0: one binary file (.glb), or JSON with an embedded buffer (.gltf).

Written without a library: a file is one JSON object and one buffer. Vertex colours are linear, not
sRGB, and are shown without lighting (KHR_materials_unlit), because they contain that of the scene.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.meshes import TriangleMesh

GLTF_SUFFIXES = (".glb", ".gltf")

_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = b"glTF", 2, b"JSON", b"BIN\0"
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963


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


class _Buffer:
    """The binary buffer and the accessors that describe it."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray, kind: str, component: int, target: int, **more: Any) -> int:
        """Append an array and return the number of its accessor."""
        data = np.ascontiguousarray(values).tobytes()
        self.views.append(
            {
                "buffer": 0,
                "byteOffset": len(self.content),
                "byteLength": len(data),
                "target": target,
            }
        )
        self.content += data + b"\0" * (-len(data) % 4)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": component,
                "count": len(values) if kind != "SCALAR" else values.size,
                "type": kind,
                **more,
            }
        )
        return len(self.accessors) - 1


def write_gltf(
    path: Path, parts: Sequence[MeshPart], T_gltf_map: NDArray[np.float64], extras: dict[str, Any]
) -> None:
    """Write parts of a mesh as `.glb` or `.gltf`.

    Args:
        parts: nodes below one root node; at least one, with triangles.
        T_gltf_map: [4, 4] transformation of the root node to glTF's axes (y up, z forward).
        extras: JSON values stored with the root node.

    Raises:
        FormatError: the suffix is not supported.
        RunFolderError: the file cannot be written.
    """
    if path.suffix not in GLTF_SUFFIXES:
        raise FormatError(f"{path}: the name must end in {' or '.join(GLTF_SUFFIXES)}")
    buffer = _Buffer()
    meshes = [{"name": p.name, "primitives": [_primitive(buffer, p.mesh)]} for p in parts]
    nodes: list[dict[str, Any]] = [
        {
            "name": "map",
            "matrix": T_gltf_map.T.ravel().tolist(),  # by columns
            "children": list(range(1, len(parts) + 1)),
            "extras": extras,
        }
    ]
    nodes += [{"name": p.name, "mesh": k, "extras": p.extras} for k, p in enumerate(parts)]
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "semsplat"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [
            {
                "name": "vertex colours",
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.content)}],
    }
    write = _glb if path.suffix == ".glb" else _embedded
    write_bytes(path, write(content, bytes(buffer.content)))


def _primitive(buffer: _Buffer, mesh: TriangleMesh) -> dict[str, Any]:
    vertices = mesh.vertices_m.astype("<f4")
    low, high = (extreme.astype(float).tolist() for extreme in (vertices.min(0), vertices.max(0)))
    colours = np.ones((len(vertices), 4))
    colours[:, :3] = linear_from_srgb(mesh.colours)
    quantised = np.rint(65535.0 * colours).astype("<u2")
    triangles = mesh.triangles.astype("<u4").ravel()
    return {
        "attributes": {
            "POSITION": buffer.add(vertices, "VEC3", _FLOAT, _VERTICES, min=low, max=high),
            "COLOR_0": buffer.add(quantised, "VEC4", _UINT16, _VERTICES, normalized=True),
        },
        "indices": buffer.add(triangles, "SCALAR", _UINT32, _INDICES),
        "material": 0,
    }


def linear_from_srgb(colours: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return linear intensities of sRGB colours, both in [0, 1]."""
    values = np.clip(colours.astype(np.float64), 0.0, 1.0)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _glb(content: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(data)
    head = _MAGIC + struct.pack("<II", _VERSION, length)
    chunks = struct.pack("<I", len(text)) + _JSON_CHUNK + text
    return head + chunks + struct.pack("<I", len(data)) + _BINARY_CHUNK + data


def _embedded(content: dict[str, Any], data: bytes) -> bytes:
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    content["buffers"][0]["uri"] = uri
    return (json.dumps(content) + "\n").encode()
