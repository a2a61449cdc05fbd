"""Files of glTF 2.0: the JSON tree, its buffers and accessors, and the transformations of nodes.

Source: the glTF 2.0 specification of the Khronos Group.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry import se3
from toolkit.io.atomic import write_bytes, write_text
from toolkit.io.guarded.content import read_content
from toolkit.io.guarded.documents import parse_json

_MAGIC, _VERSION, _JSON, _BINARY = b"glTF", 2, b"JSON", b"BIN\0"
_HEADER = 12
_MAX_BYTES = 2**32
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class GltfDocument:
    """A file of glTF 2.0.

    Attributes:
        path: the file.
        tree: its JSON.
        buffers: the buffers that were read, by index; the binary chunk of a `.glb` is the first.
    """

    path: Path
    tree: dict[str, Any]
    buffers: dict[int, bytes] = field(default_factory=dict)

    def accessor(self, index: int) -> NDArray:
        """Return the values [N, W] of an accessor; normalised integers as float64.

        Raises:
            FormatError: the data is incomplete, or stored in a way that is not supported.
        """
        accessor = entry(self.tree["accessors"], index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise FormatError(
                f"{self.path}: accessor {index} is sparse or compressed, which is not supported; "
                "write the file without compression"
            )
        view = entry(self.tree["bufferViews"], accessor["bufferView"])
        dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
        count, width = _natural(accessor["count"]), _WIDTHS[accessor["type"]]
        stride = _natural(view.get("byteStride", 0)) or dtype.itemsize * width
        start = _natural(accessor.get("byteOffset", 0))
        needed = start + stride * (count - 1) + dtype.itemsize * width
        first, length = _natural(view.get("byteOffset", 0)), _natural(view["byteLength"])
        buffer = self._buffer(_natural(view["buffer"]))
        if count == 0 or needed > length or first + length > len(buffer):
            raise FormatError(
                f"{self.path} is truncated: accessor {index} announces {count} elements, which the "
                "file does not contain; write it again"
            )
        strides = (stride, dtype.itemsize)
        values = np.ndarray((count, width), dtype, buffer, first + start, strides)
        if not accessor.get("normalized", False) or dtype.kind == "f":
            return values.copy()
        return np.maximum(values / float(np.iinfo(dtype).max), -1.0)

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            self.buffers[index] = self._outside(entry(self.tree["buffers"], index)["uri"])
        return self.buffers[index]

    def _outside(self, uri: str) -> bytes:
        """A buffer that is embedded in the JSON, or lies beside the file."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2], validate=True)
        name = PurePosixPath(unquote(uri))
        if ":" in uri or name.is_absolute() or ".." in name.parts:
            raise FormatError(f"{self.path}: buffer {uri!r} does not lie beside the file; copy it")
        try:
            return read_content(self.path.parent / name)
        except OSError as error:
            raise FormatError(
                f"{self.path} needs the file {uri!r} beside it ({error.strerror}); copy it there"
            ) from error

    def mesh_nodes(self) -> Iterator[tuple[NDArray[np.float64], tuple[dict[str, Any], ...]]]:
        """Yield the nodes of the scene that have a mesh.

        Returns:
            The global transformation [4, 4] of each, and the nodes from the root to it.
        """
        nodes = self.tree.get("nodes", [])
        waiting: list[tuple[NDArray[np.float64], tuple[dict[str, Any], ...]]] = [
            (np.eye(4), (entry(nodes, root),)) for root in reversed(self._roots())
        ]
        left = len(nodes)
        while waiting:
            T_scene_parent, path = waiting.pop()
            left -= 1
            if left < 0:
                raise ValueError("a node has several parents")
            T_scene_node = T_scene_parent @ _local(path[-1])
            if "mesh" in path[-1]:
                yield T_scene_node, path
            for child in reversed(path[-1].get("children", [])):
                waiting.append((T_scene_node, (*path, entry(nodes, child))))

    def _roots(self) -> list[int]:
        scenes, nodes = self.tree.get("scenes", []), self.tree.get("nodes", [])
        if scenes:
            return list(entry(scenes, self.tree.get("scene", 0)).get("nodes", []))
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]


def _local(node: dict[str, Any]) -> NDArray[np.float64]:
    """The transformation [4, 4] of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rotation = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    if not any(rotation):
        raise ValueError("the rotation of a node has length 0")
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion_xyzw(rotation)
    T[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    T[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return T


def entry(entries: Sequence[Any], index: Any) -> Any:
    """Return an entry of a list of the tree.

    Raises:
        ValueError: the index is negative, or no integer.
    """
    return entries[_natural(index)]


def _natural(value: Any) -> int:
    """An index or a size, which must not count from the end."""
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{value!r} is not a number of bytes or elements")
    return value


def read_document(path: Path) -> GltfDocument:
    """Read a `.glb` or `.gltf`; buffers outside the file are read when they are needed.

    Raises:
        FormatError: it is truncated, or is no glTF 2.0.
    """
    content, buffers = read_content(path), {}
    if content[:4] == _MAGIC:
        content, buffers[0] = _chunks(path, content)
    try:
        tree = parse_json(content)
        version = tree["asset"]["version"]
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is not glTF, or is truncated; write it again") from error
    if str(version).partition(".")[0] != "2":
        raise FormatError(f"{path} is glTF {version}; write it as glTF 2.0")
    return GltfDocument(path, tree, buffers)


def _chunks(path: Path, content: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a `.glb`."""
    version, length = struct.unpack_from("<II", content.ljust(_HEADER, b"\0"), 4)
    if len(content) >= _HEADER and version != _VERSION:
        raise FormatError(f"{path} is a .glb of version {version}; write it as glTF 2.0")
    if len(content) < max(length, _HEADER):
        raise FormatError(f"{path} is truncated: {len(content)} of {length} bytes; write it again")
    chunks: dict[bytes, bytes] = {}
    place = _HEADER
    while place + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, place)
        if place + 8 + size > length:
            raise FormatError(f"{path}: a chunk is longer than the file; write it again")
        chunks.setdefault(kind, content[place + 8 : place + 8 + size])
        place += 8 + size
    return chunks.get(_JSON, b""), chunks.get(_BINARY, b"")


def write_document(path: Path, tree: dict[str, Any], binary: bytes) -> None:
    """Write a `.glb`, or a `.gltf` with an embedded buffer; `tree` has one buffer, without a uri.

    Raises:
        RunFolderError: the file cannot be written, or exceeds the 4 GB of the format.
    """
    if path.suffix == ".gltf":
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        tree = {**tree, "buffers": [{"byteLength": len(binary), "uri": uri}]}
        write_text(path, json.dumps(tree, ensure_ascii=False))
        return
    text = json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    length = _HEADER + 8 + len(text) + 8 + len(binary)
    if length >= _MAX_BYTES:
        raise RunFolderError(f"cannot write {path}: a .glb is limited to 4 GB; write a .ply")
    header = _MAGIC + struct.pack("<II", _VERSION, length)
    chunks = (struct.pack("<I4s", len(text), _JSON), text)
    data = (struct.pack("<I4s", len(binary), _BINARY), binary)
    write_bytes(path, b"".join((header, *chunks, *data)))


# What a damaged tree raises when it is read.
DAMAGED = (KeyError, IndexError, TypeError, ValueError, AttributeError, binascii.Error)
