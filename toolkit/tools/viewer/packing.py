"""Compact binary form of a scene, or of a part of its Gaussians, for the page.

Positions are stored as 16-bit fractions of the bounding box, or as they are if that would be
visible; sizes as 8-bit fractions of the range of their logarithms, colours, opacities and harmonics
with 8 bits.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.io.atomic import utf8
from toolkit.tools.viewer.scene import (
    INFERRED_RGB,
    MEASURED_RGB,
    UNKNOWN_RGB,
    ShownKeyframe,
    ShownSplats,
    ViewerScene,
)

_JPEG_QUALITY = 72
_POSITION_STEPS = 65535.0
# Steps of positions are visible if they are larger than this share of a common standard deviation,
# as in maps of other programs, which reach far beyond what they show.
_VISIBLE_STEP = 0.5
# Stored shapes are this fraction of the largest value of int16.
_SHAPE_SCALE = 32767.0
# The overview shows this share of the Gaussians along each axis, whatever lies far outside.
_OVERVIEW_PERCENT = (1.0, 99.0)
# Index of unknown nodes in the page.
NO_NODE = 65535


@dataclass
class PackedScene:
    """A scene as JSON and bytes.

    Attributes:
        header: JSON values, with the position of every array in `data`.
        data: arrays one after the other, each aligned to 4 bytes.
    """

    header: dict[str, Any]
    data: bytearray = field(default_factory=bytearray)

    def add(self, name: str, array: NDArray) -> None:
        """Append an array."""
        self.data += bytes(-len(self.data) % 4)
        array = np.ascontiguousarray(array)
        self.header["arrays"][name] = {
            "offset": len(self.data),
            "length": array.size,
            "type": array.dtype.name,
        }
        self.data += array.tobytes()

    def __bytes__(self) -> bytes:
        """Length of the header (uint32), header (JSON) and arrays."""
        header = utf8(json.dumps(self.header, ensure_ascii=False, separators=(",", ":")))
        header += b" " * (-len(header) % 4)
        return len(header).to_bytes(4, "little") + header + bytes(self.data)


def pack(scene: ViewerScene) -> PackedScene:
    """Pack a scene for the page; it contains at least one Gaussian."""
    packed = PackedScene({"arrays": {}} | _header(scene))
    packed.header["overview"] = overview(scene.splats.means_m)
    _pack_splats(packed, scene.splats)
    packed.add("path", scene.path[:, :3, 3].astype(np.float32))
    packed.add("pathColours", scene.path_colours)
    voxels_m = [one.voxels_m for one in scene.objects if one.voxels_m is not None]
    if voxels_m:
        packed.add("voxels", np.concatenate(voxels_m).astype(np.float32))
    return packed


def pack_splats(splats: ShownSplats) -> PackedScene:
    """Pack one or more Gaussians alone."""
    packed = PackedScene({"arrays": {}})
    _pack_splats(packed, splats)
    return packed


def overview(means_m: NDArray[np.float32]) -> dict[str, list[float]]:
    """Return the box of nearly all positions [N, 3] as JSON values, lowest corner and extent."""
    some = means_m[:: max(len(means_m) // 100_000, 1)]
    low_m, high_m = np.percentile(some, _OVERVIEW_PERCENT, axis=0)
    return {"low": low_m.tolist(), "extent": np.maximum(high_m - low_m, 1e-6).tolist()}


def _header(scene: ViewerScene) -> dict[str, Any]:
    camera = scene.camera
    return {
        "title": scene.title,
        "total": scene.total,
        "up": [float(v) for v in scene.up],
        "tree": None
        if scene.tree is None
        else {
            "levels": list(scene.tree.levels),
            "nodes": [
                {"path": list(node.path), "level": node.level, "rgb": list(node.rgb)}
                for node in scene.tree.nodes
            ],
        },
        "camera": None
        if camera is None
        else {k: float(getattr(camera, k)) for k in ("fx", "fy", "cx", "cy", "width", "height")},
        "keyframes": [_keyframe(keyframe) for keyframe in scene.keyframes],
        "loops": [
            {"first": loop.first, "second": loop.second, "ends": loop.ends_m.ravel().tolist()}
            for loop in scene.loops
        ],
        "objects": [
            {
                "number": one.number,
                "name": one.name,
                "room": one.room,
                "corners": one.corners_m.round(4).ravel().tolist(),
                "relations": list(one.relations),
                "storey": one.storey,
                "path": list(one.path),
                "voxels": None if one.voxels_m is None else len(one.voxels_m),
            }
            for one in scene.objects
        ],
        "notes": list(scene.notes),
        "length": scene.length,
        "palette": {
            "unknown": UNKNOWN_RGB,
            "measured": MEASURED_RGB,
            "inferred": INFERRED_RGB,
        },
    }


def _keyframe(keyframe: ShownKeyframe) -> dict[str, Any]:
    return {
        "index": keyframe.index,
        "submap": keyframe.submap,
        "pose": [round(float(v), 6) for v in keyframe.T_map_camera[:3].ravel()],
        "image": None if keyframe.image is None else jpeg_url(keyframe.image),
    }


def jpeg_url(rgb: NDArray[np.uint8]) -> str:
    """Return an image [h, w, 3] as a data URL."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, content = cv2.imencode(".jpg", rgb[..., ::-1], quality)
    return "data:image/jpeg;base64," + base64.b64encode(content.tobytes()).decode()


def _pack_splats(packed: PackedScene, splats: ShownSplats) -> None:
    header = packed.header
    low, high = splats.means_m.min(axis=0), splats.means_m.max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    header["count"] = len(splats)
    header["low"], header["extent"] = low.tolist(), extent.tolist()
    step_m = float(extent.max()) / _POSITION_STEPS
    if step_m > _VISIBLE_STEP * float(np.median(splats.sigmas_m)):
        packed.add("means", splats.means_m)
    else:
        steps = np.rint((splats.means_m - low) / extent * _POSITION_STEPS)
        packed.add("means", steps.astype(np.uint16))

    logs = np.log(np.maximum(splats.sigmas_m, 1e-6))
    smallest, span = float(logs.min()), max(float(np.ptp(logs)), 1e-6)
    header["logSigma"] = [smallest, span]
    packed.add("sigmas", np.rint((logs - smallest) / span * 255.0).astype(np.uint8))

    opacities = np.rint(255.0 * splats.opacities).astype(np.uint8)
    packed.add("rgba", np.concatenate([splats.rgb, opacities[:, None]], axis=1))
    if splats.shapes is not None:
        largest = max(float(np.abs(splats.shapes).max()), 1e-6)
        header["shapeScale"] = largest / _SHAPE_SCALE
        packed.add("shapes", np.rint(splats.shapes / header["shapeScale"]).astype(np.int16))
    if splats.harmonics is not None:
        packed.add("harmonics", splats.harmonics)
    if splats.levels is not None:
        nodes = np.where(splats.levels < 0, NO_NODE, splats.levels).astype(np.uint16)
        packed.add("levels", nodes.T)
    if splats.confidence is not None:
        packed.add("confidence", np.rint(255.0 * splats.confidence).astype(np.uint8))
    if splats.submap is not None:
        packed.add("submap", splats.submap.astype(np.int32))
    if splats.inferred is not None:
        packed.add("inferred", splats.inferred.astype(np.uint8))
