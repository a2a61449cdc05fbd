"""Two walks through one small room, mapped by `semsplat run` as users do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.tools.cli.main import main

QUICK = [
    *("--mapping.first-iterations", "8"),
    *("--mapping.iterations", "3"),
    *("--mapping.final-iterations", "1"),
    *("--mapping.keyframes.interval", "1"),
    *("--loops.candidates.min-gap-frames", "100"),
]


@dataclass(frozen=True)
class RoomRuns:
    """Two runs from either end of one path.

    Attributes:
        a, b: their folders. recordings: of both.
        T_a_b: [4, 4] true motion between their worlds.
    """

    a: Path
    b: Path
    recordings: tuple[Path, Path]
    T_a_b: NDArray[np.float64]


def walk(recording: Path, out: Path, *more: str) -> list[str]:
    """The words that map a recording."""
    place = ["--dataset.kind", "synthetic", "--dataset.path", str(recording)]
    return ["run", *place, *QUICK, "--out", str(out), *more]


def make_room_runs(folder: Path) -> RoomRuns:
    """Both runs; a few seconds."""
    recordings, T_a_b = make_recordings(folder, 96, 72)
    for name, recording in zip("ab", recordings, strict=True):
        assert main(walk(recording, folder / name)) == 0
    return RoomRuns(folder / "a", folder / "b", recordings, T_a_b)


def make_recordings(
    folder: Path, width: int, height: int
) -> tuple[tuple[Path, Path], NDArray[np.float64]]:
    """Recordings from either end of one path, and the motion T_a_b [4, 4] between their worlds."""
    frames, truth = tiny_room(14, width, height)
    poses = truth.T_world_camera
    ways = {"a": list(range(9)), "b": list(range(13, 4, -1))}
    for name, way in ways.items():
        recording = folder / f"room_{name}"
        prepare_folder(recording)
        own = [replace(frames[i], index=k, timestamp_s=k / 30) for k, i in enumerate(way)]
        write_sequence(recording, own, frames[0].camera, poses[way])
    T_a_b = se3.inverse(poses[ways["a"][0]]) @ poses[ways["b"][0]]
    return (folder / "room_a", folder / "room_b"), T_a_b
