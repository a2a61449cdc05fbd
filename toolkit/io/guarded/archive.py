"""Zip archives: members are checked before they are unpacked."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Self

from toolkit.io.guarded.content import (
    DamagedError,
    PathLike,
    check_regular,
    damage,
    size_text,
)

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1
# Members of more than _ANY_RATIO bytes may be unpacked to at most this multiple of their size.
_ANY_RATIO, _MAX_RATIO = 2**24, 200
_MAX_ARCHIVE, _MAX_MEMBERS = 2**40, 1_000_000
# Of a member, and of the members of a package that is checked.
MAX_MEMBER = 2**32
_CHUNK = 2**20


class Archive:
    """A zip archive, which is read until it is closed.

    Raises:
        OSError: it cannot be read.
        DamagedError: it is no archive, is damaged, or contains a name twice.
    """

    def __init__(self, path: PathLike) -> None:
        check_regular(path, _MAX_ARCHIVE)
        with damage():
            self._opened = zipfile.ZipFile(path)
        listed = self._opened.infolist()
        self._members = {member.filename: member for member in listed}
        if len(self._members) < len(listed) or len(listed) > _MAX_MEMBERS:
            self.close()
            raise DamagedError("a member occurs twice, or there are more than a million")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    @property
    def names(self) -> list[str]:
        """Names of the members, in order."""
        return list(self._members)

    def size(self, name: str) -> int:
        """The unpacked size of a member in bytes."""
        return self._members[name].file_size

    def check(self, max_bytes: int = MAX_MEMBER) -> None:
        """Check all members.

        Args:
            max_bytes: limit of the sum of their unpacked sizes.

        Raises:
            DamagedError: one is damaged or encrypted, or they exceed the limit.
        """
        if sum(map(self.size, self._members)) > max_bytes:
            raise DamagedError(f"it would be unpacked to more than {size_text(max_bytes)}")
        for name in self._members:
            with self.opened(name) as stream:
                while stream.read(_CHUNK):
                    pass

    def read(self, name: str, max_bytes: int = MAX_MEMBER, max_ratio: float = _MAX_RATIO) -> bytes:
        """Unpack a member; arguments and errors as of `opened`."""
        with self.opened(name, max_bytes, max_ratio) as stream:
            return stream.read()

    @contextmanager
    def opened(
        self, name: str, max_bytes: int = MAX_MEMBER, max_ratio: float = _MAX_RATIO
    ) -> Iterator[IO[bytes]]:
        """A member as a stream within this context.

        Args:
            max_bytes: limit of its unpacked size.
            max_ratio: limit of the ratio of its unpacked and packed sizes, if it is large.

        Raises:
            DamagedError: there is none of this name; it is damaged, encrypted, or exceeds the
                limits.
        """
        member = self._members.get(name)
        if member is None:
            raise DamagedError(f"{name!r} is missing")
        if member.flag_bits & _ENCRYPTED:
            raise DamagedError(f"{name!r} is encrypted")
        if member.compress_type not in _METHODS:
            raise DamagedError(f"{name!r} is compressed by method {member.compress_type}")
        if member.file_size > min(max_bytes, max(_ANY_RATIO, max_ratio * member.compress_size)):
            raise DamagedError(f"{name!r} would be unpacked to {size_text(member.file_size)}")
        with damage(), self._opened.open(member) as stream:
            yield stream
