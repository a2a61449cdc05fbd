"""The masks of keyframes that the end of a run needs again, compressed."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class KeyframeMasks:
    """The masks of one keyframe.

    Attributes:
        index: frame index of the keyframe.
        submap: number of its submap.
        objects: [K] object of each mask when it was seen, 0 for none.
        shape: height and width of the sampled image of ids.
        compressed: the sampled ids, uint16.
    """

    index: int
    submap: int
    objects: NDArray[np.int32]
    shape: tuple[int, int]
    compressed: bytes

    @classmethod
    def of(
        cls, index: int, submap: int, objects: NDArray[np.int32], ids: NDArray[np.integer]
    ) -> KeyframeMasks:
        """Compress the sampled ids [h, w] of a keyframe's masks."""
        height, width = ids.shape
        packed = zlib.compress(ids.astype("<u2").tobytes(), 1)
        return cls(index, submap, objects, (height, width), packed)

    @property
    def ids(self) -> NDArray[np.int32]:
        """The sampled ids [h, w]."""
        values = np.frombuffer(zlib.decompress(self.compressed), "<u2")
        return values.reshape(self.shape).astype(np.int32)


def records_state(records: Sequence[KeyframeMasks]) -> dict[str, NDArray]:
    """Arrays of a checkpoint, for `restored_records`."""
    rows = [[r.index, r.submap, *r.shape, len(r.objects), len(r.compressed)] for r in records]
    joined = b"".join(record.compressed for record in records)
    return {
        "rows": np.array(rows, np.int64).reshape(-1, 6),
        "objects": np.concatenate([np.zeros(0, np.int32), *(r.objects for r in records)]),
        "ids": np.frombuffer(joined, np.uint8),
    }


def restored_records(arrays: dict[str, Any]) -> list[KeyframeMasks]:
    """Restore the records of `records_state`."""
    records, at_object, at_byte = [], 0, 0
    packed = np.asarray(arrays["ids"], np.uint8).tobytes()
    for index, submap, height, width, count, size in np.asarray(arrays["rows"]).tolist():
        objects = np.array(arrays["objects"][at_object : at_object + count], np.int32)
        content = packed[at_byte : at_byte + size]
        records.append(KeyframeMasks(index, submap, objects, (height, width), content))
        at_object, at_byte = at_object + count, at_byte + size
    return records
