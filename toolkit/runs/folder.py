"""Run folders: the settings of a run, its results, and what can be resumed.

config.yaml  trajectory.txt  covariances.txt  map.ply  frames.json  renders/  metrics.json
report.html  taxonomy.yaml  semantics/  submaps/  loops.jsonl  log.txt  checkpoint/{0,1}
objects.json (of runs with instances)  objects.npz (embeddings of objects)
parts/N (of maps in separate parts)  delays.csv (of runs with --pace)
live/ (while a viewer follows the run)
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError, SettingsError
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.version import __version__
from toolkit.io.arrays import arrays_below, read_array_tree, write_array_tree
from toolkit.io.atomic import cannot_write, remove_temporary, write_text
from toolkit.io.covariances import write_covariances
from toolkit.io.guarded.documents import read_json
from toolkit.io.object_embeddings import OBJECTS
from toolkit.io.splat_labels import INSTANCE, SplatLabels
from toolkit.io.splat_parts import write_splat_parts
from toolkit.io.trajectories import read_tum, write_tum
from toolkit.io.user_files import read_text
from toolkit.runs.checkpoints import CHECKPOINT_FORMAT, Checkpoints
from toolkit.runs.formats import counted, upgraded_decoder
from toolkit.runs.lock import LOCK, is_unused
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.runs.settings import other_keys
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.gaussians.cloud import GaussianCloud


class RunFolder:
    """Paths and files of a run folder."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.yaml"
        self.trajectory = path / "trajectory.txt"
        self.covariances = path / "covariances.txt"
        self.map = path / "map.ply"
        self.frames = path / "frames.json"
        self.renders = path / "renders"
        self.taxonomy = path / "taxonomy.yaml"
        self.objects = path / "objects.json"
        self.embeddings = path / OBJECTS
        self.scene_graph = path / "scene_graph.json"
        self.semantics = path / "semantics"
        self.submaps = path / "submaps"
        self.metrics = path / "metrics.json"
        self.report = path / "report.html"
        self.loops = path / "loops.jsonl"
        self.delays = path / "delays.csv"
        self.saved_map = path / "saved_map.json"
        self.log = path / "log.txt"
        self.lock = path / LOCK
        self.checkpoints = Checkpoints(path / "checkpoint")
        self.parts = path / "parts"
        self.live = path / "live"
        self.snapshot = self.live / "snapshot"
        self.watched = self.live / "watched"

    @classmethod
    def create(cls, path: Path, config: str) -> RunFolder:
        """Create the folder of a new run.

        Raises:
            RunFolderError: the folder is not empty or cannot be written.
        """
        folder = cls(path)
        if folder.config.exists():
            raise RunFolderError(
                f"{path} already contains a run; resume it, or choose another output folder"
            )
        if not is_unused(path):
            raise RunFolderError(f"{path} is not an empty folder; choose another output folder")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(path, error) from error
        # First, so that a folder whose process was killed is known to be that of a run.
        write_text(folder.config, config)
        folder.prepare()
        return folder

    def prepare(self) -> None:
        """Create what a new run contains besides its settings.

        Raises:
            RunFolderError: the folder cannot be written.
        """
        try:
            for part in (self.renders, self.checkpoints.path):
                part.mkdir(exist_ok=True)
            if not self.loops.exists():  # a refused resumption changes no file
                self.loops.touch()
        except OSError as error:
            raise cannot_write(self.path, error) from error

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open the folder of an existing run.

        Raises:
            RunFolderError: the folder contains no run.
        """
        folder = cls(path)
        if path.is_file():
            raise RunFolderError(f"{path} is a file; give the folder of a run")
        if not path.exists():
            raise RunFolderError(f"{path} contains no run: it does not exist; check the path")
        if not folder.config.is_file():
            uses = f"; render, view, export and run --map take {folder.map}"
            remedy = uses if folder.map.is_file() else ""
            raise RunFolderError(f"{path} contains no run: config.yaml is missing{remedy}")
        return folder

    @property
    def file_names(self) -> set[str]:
        """Names of the files and folders that make up a run."""
        graphs = {self.scene_graph.with_suffix(suffix) for suffix in (".jsonld", ".graphml")}
        paths = graphs | {self.checkpoints.path}
        paths |= {value for value in vars(self).values() if isinstance(value, Path)}
        return {path.name for path in paths if path.parent == self.path}

    def part(self, number: int) -> RunFolder:
        """Folder of a separate part of the map, which contains its trajectory and map."""
        return RunFolder(self.parts / str(number))

    def discard(self) -> None:
        """Remove the folder of a run that saved no checkpoint; other files in it are kept."""
        small = (self.config, self.loops, self.log, self.taxonomy, self.lock, self.saved_map)
        for path in small:
            path.unlink(missing_ok=True)
        shutil.rmtree(self.live, ignore_errors=True)
        for path in (self.renders, self.checkpoints.path, self.submaps, self.path):
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()

    def remove_leftovers(self) -> None:
        """Remove what a killed process was writing or replacing; call it in the resumed run."""
        remove_temporary(self.path)

    def check_config(self, config: str) -> None:
        """Check that a run is resumed with its own settings.

        Raises:
            SettingsError: they differ; the message contains the first differing line.
        """
        try:
            stored = read_text(self.config).splitlines()
        except (OSError, ValueError) as error:
            raise RunFolderError(f"cannot read {self.config} ({error}); start a new run") from error
        for old, new in zip_longest(stored, config.splitlines(), fillvalue="(nothing)"):
            if old != new:
                self.check_version()
                raise SettingsError(
                    f"cannot resume {self.path} with other settings: '{old.strip()}' in "
                    f"config.yaml, '{new.strip()}' now"
                )

    def check_version(self) -> None:
        """Check that this version has the options of the version that started the run.

        Raises:
            RunFolderError: it has others, so that the run cannot be resumed.
            SettingsError: config.yaml is unreadable.
        """
        keys = other_keys(self.config)
        if not keys:
            return
        saved = "stated nowhere"
        for path, serial in self.checkpoints.saved()[:1]:
            stated = {} if serial < 0 else read_json(path / "metadata.json")
            saved = f"semsplat {stated.get('version')}, checkpoint format {stated.get('format')}"
        raise RunFolderError(
            f"{self.path} cannot be resumed: its settings are those of another version ({saved}) "
            f"than this one (semsplat {__version__}, checkpoint format {CHECKPOINT_FORMAT}), which "
            f"differ in {counted(keys)}; resume with the version that started the run, or start "
            "a new run"
        )

    @property
    def is_finished(self) -> bool:
        """Whether all results are written; the report is the last one."""
        return self.metrics.is_file() and self.report.is_file()

    def check_taxonomy(self, taxonomy: Taxonomy | None) -> None:
        """Store the taxonomy of a new run; check that a resumed run uses the stored one.

        Raises:
            SettingsError: the stored taxonomy is another one.
            FormatError: the file is damaged.
        """
        if taxonomy is None:
            return
        if not self.taxonomy.exists():
            taxonomy.save(self.taxonomy)
        elif Taxonomy.load(self.taxonomy) != taxonomy:
            raise SettingsError(
                f"{self.taxonomy} is not the taxonomy of these settings and labels: the run was "
                "started with another one; set semantics.taxonomy to that file, or start a new run"
            )

    def write_map(self, parts: Iterable[MapPart]) -> None:
        """Write `map.ply`, a standard 3DGS file, with the labels and objects that the map has."""
        write_splat_parts(self.map, ((part.gaussians, part.columns()) for part in parts))

    def read_map(self) -> GaussianCloud:
        """Read the Gaussians of `map.ply`, with their features if the map has semantics."""
        cloud = read_cloud(self.map)
        if not self.semantics.is_dir():
            return cloud
        features = read_array_tree(self.semantics).arrays.get("features")
        if features is None or features.dtype != np.float16 or features.ndim != 2:
            raise FormatError(f"{self.semantics} is damaged: it has no features; run again")
        if len(features) != len(cloud):
            raise FormatError(f"{self.semantics} does not belong to {self.map}; run again")
        return replace(cloud, features=torch.from_numpy(features.astype(np.float32)))

    def write_semantics(
        self, features: NDArray[np.float16], decoder: dict[str, NDArray], taxonomy: Taxonomy
    ) -> None:
        """Write `semantics/`: features in half precision, and the state of their decoder."""
        arrays: dict[str, NDArray] = {"features": features}
        arrays |= {f"reader/{name}": array for name, array in decoder.items()}
        metadata = {"version": __version__, "taxonomy": taxonomy.digest}
        write_array_tree(self.semantics, arrays, metadata)

    def read_taxonomy(self) -> Taxonomy | None:
        """Read the taxonomy of the map's labels, None for a map without semantics.

        Raises:
            FormatError: the file is missing or damaged, or does not match the labels.
        """
        if not self.semantics.is_dir():
            return None
        if not self.taxonomy.is_file():
            raise FormatError(
                f"{self.taxonomy} is missing, which defines the labels of {self.map}; restore the "
                "file, or run again"
            )
        taxonomy = Taxonomy.load(self.taxonomy)
        if read_array_tree(self.semantics).metadata.get("taxonomy") != taxonomy.digest:
            raise FormatError(
                f"{self.taxonomy} is not the taxonomy of the labels of {self.map}; restore the "
                "file, or run again"
            )
        return taxonomy

    def read_semantics(self) -> dict[str, NDArray]:
        """Read the state of the features' decoder, empty for a map without semantics."""
        if not self.semantics.is_dir():
            return {}
        return upgraded_decoder(arrays_below(read_array_tree(self.semantics).arrays, "reader/"))

    def write_trajectory(
        self, trajectory: Trajectory, covariances: NDArray[np.float64] | None = None
    ) -> None:
        """Write `trajectory.txt` in TUM format, and `covariances.txt` [M, 6, 6] if known."""
        write_tum(self.trajectory, trajectory)
        if covariances is not None:
            write_covariances(self.covariances, trajectory.timestamps_s, covariances)

    def read_trajectory(self) -> Trajectory:
        """Read `trajectory.txt`."""
        return read_tum(self.trajectory)

    def write_json(self, path: Path, content: dict[str, Any]) -> None:
        """Write a JSON file of this folder atomically."""
        write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


@dataclass(frozen=True)
class MapPart:
    """Gaussians of a map that are written together.

    Attributes:
        gaussians: N Gaussians.
        labels: their labels; None for a map without semantics.
        submap: number of their submap; None for a map without submaps.
        instances: [N] int32, their objects; None for a map without instances.
    """

    gaussians: GaussianCloud
    labels: SplatLabels | None = None
    submap: int | None = None
    instances: NDArray[np.int32] | None = None

    def columns(self) -> dict[str, NDArray]:
        """The additional columns of the map's file."""
        columns = {} if self.labels is None else self.labels.columns()
        if self.submap is not None:
            columns["submap"] = np.full(len(self.gaussians), self.submap, np.int32)
        return columns if self.instances is None else columns | {INSTANCE: self.instances}
