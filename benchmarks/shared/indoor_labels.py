"""Labels of Replica's classes as those of the indoor segmenter."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from data_tools.training_rooms.samples import CLASS_IDS
from toolkit.io.class_names import read_class_names
from toolkit.io.images import read_labels

# Classes of Replica, whose names synthetic rooms use too, that are not `thing`.
_OF_REPLICA = {
    "floor": ("floor", "rug", "mat"),
    "wall": ("wall", "pillar", "panel", "switch", "wall-plug", "vent", "beam"),
    "ceiling": ("ceiling",), "door": ("door",), "window": ("window",),
    "blinds": ("blinds", "curtain"), "table": ("table", "table-runner"), "desk": ("desk",),
    "chair": ("chair", "stool", "bench", "beanbag"), "sofa": ("sofa",),
    "bed": ("bed", "comforter", "blanket"), "shelf": ("shelf", "rack"),
    "cabinet": ("cabinet", "base-cabinet", "wall-cabinet", "wardrobe", "nightstand", "tv-stand",
                "countertop"),
    "appliance": ("refrigerator", "microwave", "major-appliance", "small-appliance", "cooktop"),
    "sanitary": ("bathtub", "toilet", "sink", "shower-stall"), "lamp": ("lamp",),
    "screen": ("tv-screen", "monitor", "laptop"), "picture": ("picture", "clock"),
    "plant": ("indoor-plant", "plant-stand"), "cushion": ("cushion", "pillow"), "box": ("box",),
}  # fmt: skip


def relabelling(names: Mapping[int, str]) -> NDArray[np.int32]:
    """A table from class ids of Replica's names to those of `CLASS_IDS`."""
    known = {name: ours for ours, theirs in _OF_REPLICA.items() for name in theirs}
    table = np.zeros(max(names) + 1, np.int32)
    for number, name in names.items():
        table[number] = CLASS_IDS[known.get(name, "thing")]
    return table


def with_indoor_labels(source: Path) -> Path:
    """A copy of a room whose labels have the classes of the indoor segmenter."""
    folder = source.with_name(f"{source.name}-indoor")
    if not folder.is_dir():
        partial = source.with_name(f"{folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(source, partial)
        classes = partial / "labels" / "classes.json"
        table = relabelling(read_class_names(classes))
        for file in partial.rglob("label*.png"):
            cv2.imwrite(str(file), table[read_labels(file)].astype(np.uint8))
        numbered = {str(number): name for name, number in CLASS_IDS.items()}
        classes.write_text(json.dumps({"void": 0, "classes": numbered}))
        partial.rename(folder)
    return folder
