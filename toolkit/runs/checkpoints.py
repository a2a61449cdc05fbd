"""Checkpoints of a run, from which it can be resumed.

They alternate between two folders: the older one is replaced, so that a complete checkpoint exists
at any time. They are saved between frames and do not change the state of the run.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.version import __version__
from toolkit.io.arrays import read_array_tree, write_array_tree
from toolkit.io.guarded.documents import read_json

_log = logging.getLogger(__name__)

_SLOTS = ("0", "1")
# To be incremented when the state of any part of a run changes its layout.
CHECKPOINT_FORMAT = 14


@dataclass(frozen=True)
class Checkpoint:
    """Saved state of a run.

    Attributes:
        next_frame: index of the frame at which to continue.
        arrays, values: state of the SLAM system, as returned by `Slam.state`.
        frames: identifies the frames before it, see `processed_frames`; empty if not saved.
    """

    next_frame: int
    arrays: dict[str, NDArray]
    values: dict[str, Any]
    frames: dict[str, str] = field(default_factory=dict)


class Checkpoints:
    """The checkpoints in a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __bool__(self) -> bool:
        """Whether there is a checkpoint, readable or damaged."""
        return bool(self.saved())

    def save(
        self,
        next_frame: int,
        arrays: dict[str, NDArray],
        values: dict[str, Any],
        frames: Mapping[str, str] | None = None,
    ) -> None:
        """Save a checkpoint in place of the older one; arguments as in `Checkpoint`.

        Raises:
            RunFolderError: the disk is full or not writable.
        """
        saved = self.saved()
        serial = saved[0][1] + 1 if saved else 0
        target = self.path / _SLOTS[serial % 2]
        metadata = {
            "serial": serial,
            "next_frame": next_frame,
            "threads": torch.get_num_threads(),
            "version": __version__,
            "format": CHECKPOINT_FORMAT,
            "frames": dict(frames or {}),
            "values": values,
        }
        write_array_tree(target, arrays, metadata)

    def load(self) -> Checkpoint | None:
        """Load the newest readable checkpoint, None if there is none.

        Raises:
            RunFolderError: all checkpoints are damaged, another version of semsplat saved them
                in another format, or the run used another number of threads, with which results
                would differ by rounding.
        """
        damaged = []
        for path, _ in self.saved():
            try:
                tree = read_array_tree(path)
            except (FormatError, RunFolderError) as error:
                _log.warning("Checkpoint %s is damaged; trying the previous one: %s.", path, error)
                damaged.append(path)
                continue
            try:
                next_frame = int(tree.metadata["next_frame"])
                threads, values = tree.metadata["threads"], tree.metadata["values"]
                frames = dict(tree.metadata.get("frames", {}))
            except (KeyError, TypeError, ValueError) as error:
                _log.warning("Checkpoint %s is damaged (%r).", path, error)
                damaged.append(path)
                continue
            saved_format = tree.metadata.get("format")
            if saved_format != CHECKPOINT_FORMAT:
                raise RunFolderError(
                    f"{path} has checkpoint format {saved_format}, this version of semsplat reads "
                    f"format {CHECKPOINT_FORMAT}; resume with the version that started the run, "
                    "or start a new run"
                )
            if threads != torch.get_num_threads():
                raise RunFolderError(
                    f"{self.path.parent} was started with {threads} threads, but torch now uses "
                    f"{torch.get_num_threads()}; set OMP_NUM_THREADS={threads} to resume it"
                )
            return Checkpoint(next_frame, tree.arrays, values, frames)
        if damaged:
            raise RunFolderError(f"no checkpoint in {self.path} can be read; start a new run")
        return None

    def remove(self) -> None:
        """Remove the checkpoints of a run whose results are complete."""
        for name in _SLOTS:
            shutil.rmtree(self.path / name, ignore_errors=True)

    def saved(self) -> list[tuple[Path, int]]:
        """Return (folder, serial number) of the checkpoints, newest first."""
        found = []
        for name in _SLOTS:
            path = self.path / name
            try:
                serial = read_json(path / "metadata.json")["serial"]
                found.append((path, int(serial)))
            except FileNotFoundError:
                continue
            except (OSError, ValueError, KeyError, TypeError):
                found.append((path, -1))  # unreadable: replaced first
        return sorted(found, key=lambda item: -item[1])
