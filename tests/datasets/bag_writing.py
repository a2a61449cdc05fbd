"""Bags of all storages, written message by message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

STORAGES = ("ros1", "sqlite3", "mcap")


@dataclass
class BagContent:
    """Messages of a bag, and how they are made; times are in seconds."""

    storage: str = "sqlite3"
    messages: list[tuple[str, float, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        ros1 = self.storage == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)

    def make(self, name: str, **values: Any) -> Any:
        return self.store.types[name](**values)

    def header(self, time_s: float, frame_id: str) -> Any:
        seconds = int(time_s)
        time = self.make(
            "builtin_interfaces/msg/Time", sec=seconds, nanosec=round(1e9 * (time_s - seconds))
        )
        extra = {"seq": 0} if self.storage == "ros1" else {}
        return self.make("std_msgs/msg/Header", **extra, stamp=time, frame_id=frame_id)

    def image(
        self,
        topic: str,
        time_s: float,
        pixels: np.ndarray,
        encoding: str,
        frame_id: str = "camera",
        stamp_s: float | None = None,
        padding: int = 0,
    ) -> None:
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        message = self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time_s if stamp_s is None else stamp_s, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )
        self.messages.append((topic, time_s, message))

    def compressed(self, topic: str, time_s: float, data: bytes, form: str) -> None:
        message = self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time_s, "camera"),
            format=form,
            data=np.frombuffer(data, np.uint8),
        )
        self.messages.append((topic, time_s, message))

    def info(
        self,
        topic: str,
        K: Sequence[float],
        size: tuple[int, int],
        distortion: Sequence[float] = (),
        model: str = "plumb_bob",
        frame_id: str = "camera",
    ) -> None:
        """Camera info; K is fx, fy, cx, cy."""
        fx, fy, cx, cy = K
        upper = self.storage == "ros1"
        matrices = {
            "d": np.array(distortion, float),
            "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], float),
            "r": np.eye(3).ravel(),
            "p": np.array([fx + 1, 0, cx, 0, 0, fy + 1, cy, 0, 0, 0, 1, 0], float),
        }
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(1.0, frame_id),
            height=size[1],
            width=size[0],
            distortion_model=model,
            **{key.upper() if upper else key: value for key, value in matrices.items()},
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        self.messages.append((topic, 1.0, message))

    def number(self, topic: str, value: float) -> None:
        self.messages.append((topic, 1.0, self.make("std_msgs/msg/Float32", data=value)))

    def write(self, folder: Path) -> Path:
        if self.storage == "ros1":
            path = folder / "recording.bag"
            self._write(Writer1(path), self.store.serialize_ros1)
            return path
        path = folder / "recording"
        plugin = StoragePlugin.MCAP if self.storage == "mcap" else StoragePlugin.SQLITE3
        self._write(Writer2(path, version=8, storage_plugin=plugin), self.store.serialize_cdr)
        return path

    def _write(self, writer: Any, serialise: Any) -> None:
        connections: dict[str, Any] = {}
        with writer:
            for topic, time_s, message in sorted(self.messages, key=lambda entry: entry[1]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                time_ns = round(1e9 * time_s)
                writer.write(connections[topic], time_ns, serialise(message, kind))
