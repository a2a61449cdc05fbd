"""Options of datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

DatasetKind = Literal[
    "synthetic",
    "tum",
    "replica",
    "seven-scenes",
    "scannet",
    "nerfstudio",
    "stray-scanner",
    "folder",
]


@dataclass(frozen=True)
class DatasetOptions:
    """The dataset of a run."""

    kind: DatasetKind = "synthetic"
    """Layout of the dataset: synthetic, tum, replica, seven-scenes, scannet, nerfstudio,
    stray-scanner or folder."""
    path: Path | None = None
    """Folder of the dataset. By default, a synthetic room is created beside the run folder."""
