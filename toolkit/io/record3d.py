"""Images of Record3D's .r3d files by number.

A .r3d file is a zip archive with the JSON `metadata` and, for each frame N from 0, `rgbd/N.jpg`,
`rgbd/N.depth` and `rgbd/N.conf`. The latter two are compressed with LZFSE: float32 metres, row by
row, and uint8 confidence from 0 (low) to 2. Source: the app's author in the issues 4, 7, 83 and 93
of github.com/marek-simonik/record3d.

The app's export of EXR and JPG files is a folder with `metadata.json`, `rgb/N.jpg` and
`depth/N.exr` (metres).
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, DependencyError
from toolkit.io.exr import read_exr
from toolkit.io.guarded.archive import Archive
from toolkit.io.guarded.content import read_content
from toolkit.io.guarded.documents import parse_json
from toolkit.io.guarded.images import decoded
from toolkit.io.guarded.lzfse_streams import decompressed
from toolkit.io.user_files import visible

# Images and notes are far smaller.
_MAX_MEMBER = 2**26
_METADATA, EXPORTED_METADATA = "metadata", "metadata.json"
_FRAME = re.compile(r"(?:rgbd|rgb|depth)/(\d+)\.(jpg|depth|conf|exr)")


class Record3DFile:
    """Reads frames of a .r3d file, or of the folder with its content, when they are needed.

    Attributes:
        path: of the file.
        metadata: content of `metadata`.
        colour_frames, depth_frames: numbers of frames with the image, ascending.

    Raises:
        DatasetError: the file is missing, damaged or not of Record3D.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._archive: Archive | None = None
        if not path.exists():
            raise DatasetError(f"{path} does not exist; check the path")
        if path.is_file():
            try:
                self._archive = Archive(path)
            except (OSError, ValueError) as error:
                raise DatasetError(
                    f"{path} is truncated or not a .r3d file ({error}); export it again"
                ) from error
        names = self._archive.names if self._archive else _files_below(path)
        self._metadata_name = EXPORTED_METADATA if EXPORTED_METADATA in names else _METADATA
        self._colour = "rgbd/{}.jpg" if self._metadata_name == _METADATA else "rgb/{}.jpg"
        frames: dict[str, list[int]] = {"jpg": [], "depth": [], "conf": [], "exr": []}
        for match in filter(None, map(_FRAME.fullmatch, names)):
            frames[match.group(2)].append(int(match.group(1)))
        if self._metadata_name not in names or not frames["jpg"]:
            raise DatasetError(
                f"{path} has no {_METADATA} or no rgbd/0.jpg, as recordings of Record3D have; "
                f"export it as .r3d"
            )
        self.colour_frames = sorted(frames["jpg"])
        self.depth_frames = sorted(frames["depth"] or frames["exr"])
        self._is_exported = bool(frames["exr"])
        self._confident = set(frames["conf"])
        self.metadata = self._read_metadata()
        self._size = self.rgb(self.colour_frames[0]).shape[1::-1]

    @property
    def colour_size(self) -> tuple[int, int]:
        """Width and height of the first colour image."""
        width, height = self._size
        return width, height

    def rgb(self, number: int) -> NDArray[np.float32]:
        """Decode colour image `number` as [H, W, 3] float32 RGB in [0, 1].

        Raises:
            DatasetError: it is missing or damaged.
        """
        name = self._colour.format(number)
        try:
            bgr = decoded(self._read(name), cv2.IMREAD_COLOR_BGR)
        except ValueError as error:
            raise DatasetError(
                f"{name} in {self.path} is damaged ({error}); export it again"
            ) from error
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.float32) / np.float32(255.0)

    def depth_m(self, number: int) -> NDArray[np.float32]:
        """Decode depth image `number` as [H, W] float32 metres, 0 where missing or not confident.

        Raises:
            DatasetError: it is missing or damaged.
            DependencyError: the package that decodes it is not installed.
        """
        if self._is_exported:
            return self._exported_depth_m(number)
        name = f"rgbd/{number}.depth"
        values = np.frombuffer(self._decompressed(name), np.float32)
        shape = self._depth_shape(values.size, name)
        depth_m = np.where(np.isfinite(values) & (values > 0), values, np.float32(0.0))
        if number in self._confident:
            confidence = np.frombuffer(self._decompressed(f"rgbd/{number}.conf"), np.uint8)
            # Recordings of the front camera have confidence files without content.
            if confidence.size == values.size:
                depth_m[confidence == 0] = 0.0
        return depth_m.reshape(shape).astype(np.float32)

    def _exported_depth_m(self, number: int) -> NDArray[np.float32]:
        file = self.path / f"depth/{number}.exr"
        try:
            depth_m = read_exr(file, "record3d").astype(np.float32)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{file} is damaged ({error}); export it again") from error
        if depth_m.ndim != 2:
            raise DatasetError(f"{file} has no single channel; export it again")
        return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0.0))

    def _depth_shape(self, count: int, name: str) -> tuple[int, int]:
        """Height and width by the metadata, which early versions lack, or by the aspect ratio."""
        width, height = self.metadata.get("dw"), self.metadata.get("dh")
        if isinstance(width, int) and isinstance(height, int) and width * height == count:
            return height, width
        aspect = self.colour_size[0] / self.colour_size[1]
        guess = round(math.sqrt(count / aspect)) if count else 0
        if guess == 0 or count % guess or abs(count / guess / guess / aspect - 1.0) > 0.02:
            raise DatasetError(
                f"{name} in {self.path} has {count} values, which fit neither its size in "
                f"{_METADATA} nor the shape of colour; export it again"
            )
        return guess, count // guess

    def _read_metadata(self) -> dict[str, Any]:
        try:
            content = parse_json(self._read(self._metadata_name))
        except ValueError as error:
            raise DatasetError(
                f"{_METADATA} in {self.path} is not JSON ({error}); export it again"
            ) from error
        if not isinstance(content, dict):
            raise DatasetError(f"{_METADATA} in {self.path} is not a JSON object; export it again")
        return content

    def _read(self, name: str) -> bytes:
        try:
            if self._archive is None:
                return read_content(self.path / name, _MAX_MEMBER)
            return self._archive.read(name, _MAX_MEMBER)
        except (KeyError, OSError, ValueError) as error:
            raise DatasetError(
                f"cannot read {name} in {self.path} ({error}); export it again"
            ) from error

    def _decompressed(self, name: str) -> bytes:
        try:
            import lzfse
        except ImportError as error:
            raise DependencyError(
                f"depth of Record3D is decompressed by lzfse, which cannot be loaded ({error}); "
                "fix it with: pip install 'semsplat[record3d]'"
            ) from error
        try:
            return decompressed(self._read(name), lzfse)
        except ValueError as error:
            raise DatasetError(
                f"{name} in {self.path} is damaged ({error}); export it again"
            ) from error


def _files_below(folder: Path) -> list[str]:
    """Names of the metadata and of the images, as in the archive."""
    files = [folder / _METADATA, folder / EXPORTED_METADATA]
    for name in ("rgbd", "rgb", "depth"):
        images = folder / name
        files += visible(images) if images.is_dir() else ()
    return [file.relative_to(folder).as_posix() for file in files if file.is_file()]
