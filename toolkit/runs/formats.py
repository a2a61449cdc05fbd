"""Formats of run folders: which one a folder has, and how finished runs of older ones are read.

Jobs that read a map and few settings read every format. Jobs that depend on all settings require
the format and the settings of this version.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError
from toolkit.base.version import __version__
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.runs.settings import RunSettings

_log = logging.getLogger(__name__)

# Format of the files of a finished run, to be incremented when a name in them changes
# (tests/runs/test_run_formats.py lists the names):
# 1: frames.json has no states and parts, lengths are in metres unless the run has no depth
# 2: states and parts of the map; stated in frames.json since 29 November 2026
RUN_FORMAT = 2
# Keys of frames.json by which folders that state no format are told apart.
_SINCE_2 = frozenset(("states", "parts", "metric"))


@dataclass(frozen=True)
class FolderVersion:
    """The version of a run folder.

    Attributes:
        format: number of the format of its files.
        release: version of semsplat that wrote it, empty if not stated.
        ignored: settings in it that this version lacks, or whose value it does not accept.
    """

    format: int = RUN_FORMAT
    release: str = __version__
    ignored: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Both versions, for messages."""
        release = f"semsplat {self.release}" if self.release else "an earlier version"
        return (
            f"written by {release} (run folder format {self.format}), this is semsplat "
            f"{__version__} (format {RUN_FORMAT})"
        )

    def log(self, place: object) -> None:
        """Log that settings are ignored, if there are any."""
        if self.ignored:
            _log.warning("%s was %s; ignored settings: %s.", place, self, counted(self.ignored))

    def require_settings(
        self, place: object, groups: tuple[str, ...], job: str, remedy: str
    ) -> None:
        """Check that the settings that a job depends on are known exactly.

        Args:
            place: the run folder.
            groups: keys of the settings and groups of settings that the job depends on.
            job: what cannot be done with the folder, such as "refined".
            remedy: another way to reach the same.

        Raises:
            RunFolderError: the folder has another format, or ignored settings in these groups.
        """
        prefixes = tuple(f"{group}." for group in groups)
        unknown = [key for key in self.ignored if f"{key}.".startswith(prefixes)]
        if self.format == RUN_FORMAT and not unknown:
            return
        lacks = f"; unknown settings: {counted(unknown)}" if unknown else ""
        raise RunFolderError(
            f"{place} cannot be {job}: it was {self}{lacks}; use the version that wrote it, or "
            f"{remedy}"
        )


def counted(keys: Sequence[str]) -> str:
    """The first of the keys, and the number of the others, for messages."""
    return f"{keys[0]} and {len(keys) - 1} more" if len(keys) > 1 else "".join(keys)


def folder_version(frames: Mapping[str, Any], ignored: tuple[str, ...]) -> FolderVersion:
    """The version of a finished run.

    Args:
        frames: content of frames.json.
        ignored: see `FolderVersion`.

    Raises:
        ValueError: the stated format is no number.
    """
    stated = frames.get("format")
    if stated is None:
        return FolderVersion(2 if _SINCE_2 & set(frames) else 1, "", ignored)
    return FolderVersion(int(stated), str(frames.get("version", "")), ignored)


def upgraded(
    frames: dict[str, Any], version: FolderVersion, settings: RunSettings
) -> dict[str, Any]:
    """The content of frames.json with the keys of the current format.

    Args:
        frames: content of the file, of any format.
        version: of the folder.
        settings: of the run.

    Raises:
        KeyError, TypeError, ValueError: the content is malformed.
    """
    if version.format != 1:
        return frames
    submaps = [row | {"part": 0} for row in frames["submaps"]]
    keyframes = {int(index) for index in frames["keyframes"]}
    tracked = [int(row["index"]) for row in frames["frames"]]
    states: list[dict[str, Any]] = [
        {"index": index, "state": "tracked", "part": 0, "keyframe": index in keyframes}
        for index in tracked
    ]
    states += [{"index": int(index), "state": "lost"} for index in frames["lost"]]
    part = {
        "number": 0,
        "submaps": [row["number"] for row in submaps if not row["lost"]],
        "frames": len(tracked),
        "first": min(tracked, default=None),
        "last": max(tracked, default=None),
        "loss": None,
    }
    return frames | {
        "submaps": submaps,
        "states": sorted(states, key=lambda row: int(row["index"])),
        "parts": [part],
        "metric": settings.depth == "sensor" or settings.scale != ScaleOptions(),
        "units_per_metre": 1.0,
    }


def upgraded_decoder(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """The state of the features' decoder with the names of the current format."""
    return {{"told": "observed"}.get(name, name): array for name, array in arrays.items()}
