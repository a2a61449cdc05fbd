"""Move the frames of a run with their submaps."""

from __future__ import annotations

import bisect
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io.trajectories import read_tum, write_tum

Array = NDArray[np.float64]


def moved_frames(
    trajectory: bytes,
    frames: dict[str, Any],
    T_old: Mapping[int, Array],
    T_new: Mapping[int, Array],
    exposures: Mapping[int, Exposure],
) -> tuple[bytes, dict[str, Any]]:
    """Move poses and exposures of all frames with the submap that each was tracked in.

    Args:
        trajectory: content of trajectory.txt.
        frames: content of frames.json.
        T_old, T_new: T_world_submap [4, 4] before and after, by number.
        exposures: exposure of each submap relative to the new map, by number.

    Returns:
        The new content of both files.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "trajectory.txt"
        path.write_bytes(trajectory)
        old = read_tum(path)
        submaps = [submap_of(frames, row["index"]) for row in frames["frames"]]
        moves = {n: T_new[n] @ se3.inverse(T_old[n]) for n in T_new}
        changed = {n for n in T_new if not np.array_equal(T_new[n], T_old[n])}
        poses = [
            se3.orthonormalise(moves[n] @ T) if n in changed else T
            for n, T in zip(submaps, old.T_world_camera, strict=True)
        ]
        poses_array = np.array(poses).reshape(-1, 4, 4)
        write_tum(path, Trajectory(old.timestamps_s, poses_array))
        text = _with_lines_kept(path.read_bytes(), trajectory, [n in changed for n in submaps])
    changes = _changes(frames, exposures)
    rows = []
    for row, number in zip(frames["frames"], submaps, strict=True):
        exposure = Exposure.from_values(row)
        if number in changes:
            exposure = changes[number].after(exposure)
        rows.append(row | asdict(exposure))
    anchored = [
        row | _anchor(T_new[row["number"]], exposures.get(row["number"], _exposure_of(row)))
        if row["number"] in T_new
        else row
        for row in frames["submaps"]
    ]
    return text, frames | {"frames": rows, "submaps": anchored}


def _changes(frames: dict[str, Any], new: Mapping[int, Exposure]) -> dict[int, Exposure]:
    """Exposure of the old map relative to the new one, by submaps whose exposure changed."""
    old = {row["number"]: _exposure_of(row) for row in frames["submaps"]}
    return {n: new[n].after(old[n].inverse()) for n in old if n in new and new[n] != old[n]}


def _exposure_of(row: dict[str, Any]) -> Exposure:
    """Exposure of a submap relative to its map."""
    return Exposure.from_values(row["exposure"])


def _anchor(T_world_submap: Array, exposure: Exposure) -> dict[str, Any]:
    return {"T_world_submap": T_world_submap.tolist(), "exposure": asdict(exposure)}


def _with_lines_kept(text: bytes, before: bytes, changed: list[bool]) -> bytes:
    """The lines of poses that changed, and the former ones of others, whose rounding may differ."""
    lines, old_lines = text.splitlines(keepends=True), before.splitlines(keepends=True)
    numbers = [n for n, line in enumerate(lines) if not line.startswith(b"#")]
    old = [line for line in old_lines if line.strip() and not line.startswith(b"#")]
    for number, line, moved in zip(numbers, old, changed, strict=True):
        if not moved:
            lines[number] = line
    return b"".join(lines)


def submap_of(frames: dict[str, Any], index: int) -> int:
    """Return the submap that a frame was tracked in: the newest one that had begun."""
    begun = sorted((row["keyframes"][0], row["number"]) for row in frames["submaps"])
    place = bisect.bisect_right(begun, (index, float("inf"))) - 1
    return int(begun[max(place, 0)][1])
