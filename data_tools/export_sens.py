"""Export the frames of a ScanNet `.sens` file.

    python data_tools/export_sens.py scene0000_00.sens scene0000_00

writes color/N.jpg, depth/N.png (millimetres), pose/N.txt and intrinsic/*.txt, which
`--dataset.kind scannet` reads. Colour images are copied without recompression. The format is
version 4 of ScanNet's SensReader (https://github.com/ScanNet/ScanNet).
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.base.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.images import write_depth_png, write_png
from toolkit.tools.cli.errors import one_line_errors

VERSION = 4
DEPTH_VALUES_PER_METRE = 1000.0
# Suffix of the image file by colour compression type; None for raw.
_COLOUR_SUFFIXES = {0: None, 1: ".png", 2: ".jpg"}
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1


@dataclass(frozen=True)
class SensHeader:
    """Header of a `.sens` file.

    Attributes:
        sensor: name of the device.
        intrinsics: 4x4 matrices by name: intrinsics and extrinsics of colour and depth.
        colour_compression, depth_compression: compression types as stored in the file.
        colour_size, depth_size: (width, height) in pixels.
        depth_scale: depth values per metre.
        frames: number of frames.
    """

    sensor: str
    intrinsics: dict[str, NDArray[np.float32]]
    colour_compression: int
    depth_compression: int
    colour_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float
    frames: int


@dataclass(frozen=True)
class SensFrame:
    """One frame: pose [4, 4] camera to world, and the compressed bytes of both images."""

    T_world_camera: NDArray[np.float32]
    colour: bytes
    depth: bytes


class SensFile:
    """A `.sens` file that is read sequentially with one frame in memory at a time.

    Args:
        stream: the opened file.
        name: name of the file for error messages.

    Raises:
        FormatError: the file is not a `.sens` file of a supported version and compression.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self._stream = stream
        self._name = name
        self.header = self._read_header()

    def frames(self) -> Iterator[SensFrame]:
        """Yield all frames in order.

        Raises:
            FormatError: the file ends before its last frame.
        """
        for _ in range(self.header.frames):
            pose = self._matrix()
            _, _, colour_bytes, depth_bytes = self._unpack("<4Q")
            yield SensFrame(pose, self._bytes(colour_bytes), self._bytes(depth_bytes))

    def _read_header(self) -> SensHeader:
        (version,) = self._unpack("<I")
        if version != VERSION:
            raise FormatError(
                f"{self._name} is not a .sens file of version {VERSION} (found {version}); "
                "download it again"
            )
        (length,) = self._unpack("<Q")
        sensor = self._bytes(length).decode("latin-1")
        names = ("intrinsic_color", "extrinsic_color", "intrinsic_depth", "extrinsic_depth")
        intrinsics = {name: self._matrix() for name in names}
        colour_compression, depth_compression = self._unpack("<2i")
        colour_width, colour_height, depth_width, depth_height = self._unpack("<4I")
        (depth_scale,) = self._unpack("<f")
        (frames,) = self._unpack("<Q")
        known = colour_compression in _COLOUR_SUFFIXES
        if not known or depth_compression not in (_RAW_DEPTH, _ZLIB_DEPTH):
            raise FormatError(
                f"the compression of {self._name} is not supported (colour {colour_compression}, "
                f"depth {depth_compression}); export it with ScanNet's reader"
            )
        return SensHeader(
            sensor,
            intrinsics,
            colour_compression,
            depth_compression,
            (colour_width, colour_height),
            (depth_width, depth_height),
            depth_scale,
            frames,
        )

    def _bytes(self, count: int) -> bytes:
        content = self._stream.read(count)
        if len(content) < count:
            raise FormatError(f"{self._name} is truncated; download it again")
        return content

    def _unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self._bytes(struct.calcsize(layout)))

    def _matrix(self) -> NDArray[np.float32]:
        return np.frombuffer(self._bytes(64), dtype="<f4").reshape(4, 4)


def depth_values(header: SensHeader, frame: SensFrame) -> NDArray[np.uint16]:
    """Decompress the depth image [H, W] of a frame.

    Raises:
        FormatError: the data are not an image of the size in the header.
    """
    width, height = header.depth_size
    try:
        content = (
            zlib.decompress(frame.depth) if header.depth_compression == _ZLIB_DEPTH else frame.depth
        )
        return np.frombuffer(content, dtype="<u2").reshape(height, width)
    except (zlib.error, ValueError) as error:
        raise FormatError(f"a depth image is damaged ({error}); download the file again") from error


def write_frame(out: Path, number: int, header: SensHeader, frame: SensFrame) -> None:
    """Write colour, depth and pose of one frame below `out`."""
    suffix = _COLOUR_SUFFIXES[header.colour_compression]
    if suffix is None:
        width, height = header.colour_size
        rgb = np.frombuffer(frame.colour, np.uint8).reshape(height, width, 3)
        write_png(out / "color" / f"{number}.png", rgb)
    else:
        write_bytes(out / "color" / f"{number}{suffix}", frame.colour)
    depth_m = depth_values(header, frame) / np.float64(header.depth_scale)
    write_depth_png(out / "depth" / f"{number}.png", depth_m, DEPTH_VALUES_PER_METRE)
    write_bytes(out / "pose" / f"{number}.txt", _matrix_text(frame.T_world_camera))


def _matrix_text(matrix: NDArray) -> bytes:
    return "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in matrix).encode("ascii")


@dataclass(frozen=True)
class ExportOptions:
    """Export the frames of a ScanNet .sens file."""

    sens: tyro.conf.Positional[Path]
    """The .sens file."""
    out: tyro.conf.Positional[Path]
    """Output folder; created if it does not exist."""
    every: int = 1
    """Export every n-th frame; frames keep their numbers."""
    max_frames: int | None = None
    """Maximum number of frames to export."""


def export(options: ExportOptions) -> int:
    """Export a file and return the number of frames written.

    Raises:
        FormatError: the file is damaged or not supported.
        RunFolderError: the frames cannot be written.
    """
    for name in ("color", "depth", "pose", "intrinsic"):
        (options.out / name).mkdir(parents=True, exist_ok=True)
    written = 0
    with options.sens.open("rb") as stream:
        sens = SensFile(stream, str(options.sens))
        for name, matrix in sens.header.intrinsics.items():
            write_bytes(options.out / "intrinsic" / f"{name}.txt", _matrix_text(matrix))
        frames = tqdm(sens.frames(), total=sens.header.frames, unit="frame")
        for number, frame in enumerate(frames):
            if written == options.max_frames:
                break
            if number % options.every == 0:
                write_frame(options.out, number, sens.header, frame)
                written += 1
    return written


def main(argv: Sequence[str]) -> int:
    """Run the program and return its exit status."""
    options = tyro.cli(ExportOptions, args=list(argv))
    written = export(options)
    print(f"wrote {written} frames to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(one_line_errors(lambda: main(sys.argv[1:])))
