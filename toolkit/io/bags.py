"""Messages of ROS bags by number: ROS 1 .bag, ROS 2 folders, .db3 and .mcap files."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from toolkit.base.errors import DatasetError, DependencyError, ToolkitError
from toolkit.io.guarded.content import check_regular
from toolkit.io.user_files import visible

SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
# Of a file, and of the metadata, which list topics and parts; rosbags needs seconds for a megabyte.
_MAX_BYTES, _MAX_METADATA = 2**42, 2**18


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        message_type: for instance "sensor_msgs/msg/Image".
        count: number of messages.
    """

    name: str
    message_type: str
    count: int


@dataclass(frozen=True)
class MessagePosition:
    """Where a message is, and when it was recorded.

    Attributes:
        recorded_ns: time at which the message was recorded, nanoseconds.
        repeat: number of earlier messages of the topic with the same time.
        stamp_s: time in the message's header, seconds.
    """

    recorded_ns: int
    repeat: int
    stamp_s: float


class BagFile:
    """Reads messages of a bag when they are needed.

    A bag may be read by several threads: each has a reader of its own.

    Args:
        path: a .bag, .mcap or .db3 file, the folder of a ROS 2 bag, or a folder with one of these.

    Raises:
        DatasetError: the bag is missing, damaged, or not the only one in the folder.
        DependencyError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = _bag_at(path)
        self._local = threading.local()
        counts: dict[tuple[str, str], int] = {}
        with self._reporting():
            for connection in self._reader().connections:
                key = connection.topic, connection.msgtype
                if not all(isinstance(text, str) for text in key):
                    raise ValueError(f"{key} are no names of a topic and of its type")
                counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(*key, count) for key, count in counts.items())
        if not any(topic.count for topic in self.topics):
            raise DatasetError(f"{self.path} contains no messages; record or copy it again")

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, None without messages."""
        with self._reporting():
            reader = self._reader()
            for connection, _, raw in reader.messages(self._connections([topic])):
                return reader.deserialize(raw, connection.msgtype)
        return None

    def positions(self, topics: Iterable[str]) -> dict[str, list[MessagePosition]]:
        """Find all messages of topics whose messages start with a header, by reading once."""
        found: dict[str, list[MessagePosition]] = {topic: [] for topic in topics}
        with self._reporting():
            reader = self._reader()
            stamp_s = _stamp_ros2 if reader.is2 else _stamp_ros1
            for connection, time_ns, raw in reader.messages(self._connections(found)):
                before = found[connection.topic]
                same = before[-1].repeat + 1 if before and before[-1].recorded_ns == time_ns else 0
                before.append(MessagePosition(time_ns, same, stamp_s(raw)))
        return found

    def message(self, topic: str, position: MessagePosition) -> Any:
        """Read one message."""
        start = position.recorded_ns
        with self._reporting():
            reader = self._reader()
            messages = reader.messages(self._connections([topic]), start, start + 1)
            connection, _, raw = next(islice(messages, position.repeat, None))
            return reader.deserialize(raw, connection.msgtype)

    def _connections(self, topics: Iterable[str]) -> list[Any]:
        wanted = set(topics)
        return [c for c in self._reader().connections if c.topic in wanted]

    def _reader(self) -> Any:
        """The reader of this thread: SQLite's connections are bound to the thread."""
        if not hasattr(self._local, "reader"):
            self._local.reader = _opened(self.path)
        return self._local.reader

    @contextmanager
    def _reporting(self) -> Iterator[None]:
        """Report a damaged bag in one line."""
        try:
            yield
        except ToolkitError:
            raise
        except Exception as error:  # decompressors, SQLite and rosbags raise errors of their own
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(
                f"{self.path} is damaged or not a bag ({reason}); copy it again, or repair it with "
                "`rosbag reindex` or `ros2 bag reindex`"
            ) from error


def _bag_at(path: Path) -> Path:
    """The bag at a path, or the only one in a folder."""
    if not path.exists():
        raise DatasetError(f"{path} does not exist; check the path")
    if not path.is_dir():
        if path.suffix not in SUFFIXES:
            raise DatasetError(
                f"{path} is not a bag; specify a file with suffix {', '.join(SUFFIXES)}, or the "
                f"folder of a ROS 2 bag"
            )
        return path
    if (path / _METADATA).exists():
        return path
    inside = [
        file
        for file in visible(path)
        if (file.is_file() and file.suffix in SUFFIXES) or (file / _METADATA).exists()
    ]
    if len(inside) == 1:
        return inside[0]
    names = ", ".join(file.name for file in inside[:3])
    raise DatasetError(
        f"{path} contains {len(inside)} bags ({names}{', ...' if len(inside) > 3 else ''}); "
        f"specify the path of one"
        if inside
        else f"{path} contains no bag ({', '.join(SUFFIXES)} or a folder with {_METADATA}); check "
        f"the path"
    )


def _opened(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise DependencyError(
            f"bags are read by rosbags, which cannot be loaded ({error}); fix it with: "
            "pip install 'semsplat[bags]'"
        ) from error
    # A pipe would be waited for.
    for file in visible(path) if path.is_dir() else [path]:
        if not file.is_dir():
            check_regular(file, _MAX_METADATA if file.name == _METADATA else _MAX_BYTES)
    # Bags of early ROS 2 do not contain the definitions of their messages.
    reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
    reader.open()
    return reader


def _stamp_ros1(raw: bytes) -> float:
    """Time of the header with which a serialised message starts: sequence, seconds, nanoseconds."""
    _, seconds, nanoseconds = struct.unpack_from("<III", raw)
    return float(seconds) + 1e-9 * float(nanoseconds)


def _stamp_ros2(raw: bytes) -> float:
    """The same in CDR: encapsulation, of whose second byte bit 0 is the byte order, and time."""
    seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return float(seconds) + 1e-9 * float(nanoseconds)
