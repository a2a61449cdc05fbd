"""The map of a finished run in local or shared storage, as tasks and their driver see it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError, SettingsError
from toolkit.base.geometry import se3
from toolkit.io import storage
from toolkit.io.arrays import arrays_below
from toolkit.io.guarded.documents import parse_json
from toolkit.io.splats import is_splat_file
from toolkit.runs.formats import folder_version
from toolkit.runs.settings import RunSettings, load_stored_settings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.length_unit import LengthUnit
from toolkit.slam.mapping.semantic_mapping import SemanticMapping, build_semantic_mapping
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]

# Groups of settings that the refinement uses.
_USED_SETTINGS = ("backend", "loops", "mapping", "registration", "seed", "semantics", "submaps")
# Number and version of a submap, as in `SubmapStore`.
_SUBMAP = re.compile(r"(\d{4,})_(\d+)")


@dataclass(frozen=True)
class StoredMap:
    """Where the submaps of a run are, and what is needed to work on them; small.

    Attributes:
        place: run folder, a path or a URL.
        settings: settings of the run.
        taxonomy: taxonomy of the labels, or None.
        anchors: T_world_submap [4, 4] at the end of the run, by number; of the main part only, and
            in `unit`.
        versions: version of each submap's folder.
        decoder: place of the decoder's state, or None without semantics.
        unit: of length, in which the tasks work; files are in metres.
    """

    place: str
    settings: RunSettings
    taxonomy: Taxonomy | None
    anchors: Mapping[int, Array]
    versions: Mapping[int, int]
    decoder: str | None = None
    unit: LengthUnit = field(default_factory=LengthUnit)

    def submap(self, number: int) -> Submap:
        """Read a submap in `unit`; its anchor has the pose in `anchors`.

        Raises:
            ToolkitError: it is missing or damaged.
        """
        name = f"{number:04d}_{self.versions[number]}"
        tree = storage.read_tree(storage.join(self.place, "submaps", name))
        try:
            submap = self.unit.submap(Submap.from_state(tree.arrays, tree.metadata))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"submap {name} of {self.place} is damaged ({error!r}); run again"
            ) from error
        submap.T_world_submap = np.array(self.anchors[number])
        return submap

    def semantics(self) -> SemanticMapping:
        """Build the decoder of the features; without channels for a map without semantics."""
        options = self.settings.semantics
        if self.taxonomy is None or self.decoder is None:
            return SemanticMapping()
        code = build_code(options.code, self.taxonomy)
        semantics = build_semantic_mapping(options, code, self.settings.seed)
        state = storage.read_tree(self.decoder).arrays
        semantics.restore(arrays_below(state, "reader/"))
        return semantics


def open_stored_map(place: str) -> tuple[StoredMap, dict[str, Any]]:
    """Open the map of a finished run.

    Returns:
        The map, and the content of frames.json.

    Raises:
        ToolkitError: there is no finished run, a file is damaged, or the map cannot be refined in
            parts.
    """
    if "config.yaml" not in storage.names_in(place):
        raise RunFolderError(
            f"{place} contains no run: config.yaml is missing; give the folder of a run, which for "
            "a splat file is that of semsplat run --map"
        )
    if not {"map.ply", "frames.json", "trajectory.txt"} <= set(storage.names_in(place)):
        raise RunFolderError(
            f"{place} has no map: the run is not finished; repeat its semsplat run command with "
            "--resume"
        )
    with TemporaryDirectory() as folder:
        config = _fetched(place, "config.yaml", folder)
        settings, ignored = load_stored_settings(config)
        taxonomy = None
        if storage.names_in(storage.join(place, "semantics")):
            taxonomy = Taxonomy.load(_fetched(place, "taxonomy.yaml", folder))
    frames = read_json(storage.join(place, "frames.json"))
    _check_version(place, frames, ignored)
    unit = _unit(place, frames)
    anchors = {number: unit.pose(T) for number, T in _anchors(place, frames).items()}
    versions = _versions(place)
    missing = [number for number in anchors if number not in versions]
    if missing or not anchors:
        raise RunFolderError(f"submaps are missing in {place}/submaps; run again")
    _check_refinable(place, settings, taxonomy)
    return StoredMap(place, settings, taxonomy, anchors, versions, unit=unit), frames


def read_json(place: str) -> dict[str, Any]:
    """Read a JSON file with a dictionary.

    Raises:
        FormatError: the file is damaged.
    """
    try:
        content = parse_json(storage.read_bytes(place))
    except ValueError as error:
        raise FormatError(f"{place} is not JSON ({error}); run again") from error
    if not isinstance(content, dict):
        raise FormatError(f"{place} does not contain a dictionary; run again")
    return content


def _check_version(place: str, frames: dict[str, Any], ignored: tuple[str, ...]) -> None:
    try:
        version = folder_version(frames, ignored)
    except (TypeError, ValueError) as error:
        raise FormatError(f"{place}/frames.json is damaged ({error!r}); run again") from error
    remedy = f"run --map {place}/map.ply to extend its map"
    version.require_settings(place, _USED_SETTINGS, "refined", remedy)


def _check_refinable(place: str, settings: RunSettings, taxonomy: Taxonomy | None) -> None:
    if settings.map is not None and not is_splat_file(settings.map):
        raise SettingsError(
            f"{place} extends the map of another run, whose submaps are fixed; refine that run"
        )
    if taxonomy is not None and settings.semantics.reader == "network":
        raise SettingsError(
            f"{place} decodes classes with a network that all submaps share (semantics.reader "
            "network); such a map is refined at the end of its run only"
        )


def _fetched(place: str, name: str, folder: str) -> Path:
    path = Path(folder) / name
    path.write_bytes(storage.read_bytes(storage.join(place, name)))
    return path


def _unit(place: str, frames: dict[str, Any]) -> LengthUnit:
    """The unit in which the run worked."""
    per_metre = frames.get("units_per_metre")
    if not isinstance(per_metre, float | int) or not 0.0 < per_metre < float("inf"):
        raise FormatError(f"{place}/frames.json: units_per_metre must be positive; run again")
    return LengthUnit(float(per_metre))


def _anchors(place: str, frames: dict[str, Any]) -> dict[int, Array]:
    try:
        anchors = {
            int(row["number"]): np.array(row["T_world_submap"], np.float64).reshape(4, 4)
            for row in frames["submaps"]
            if not row["lost"] and row["part"] == 0
        }
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{place}/frames.json is damaged ({error!r}); run again") from error
    if not all(se3.is_rigid(T) for T in anchors.values()):
        raise FormatError(f"{place}/frames.json: the pose of a submap is not rigid; run again")
    return anchors


def _versions(place: str) -> dict[int, int]:
    versions: dict[int, int] = {}
    for name in storage.names_in(storage.join(place, "submaps")):
        found = _SUBMAP.fullmatch(name)
        if found:
            number, version = int(found[1]), int(found[2])
            versions[number] = max(version, versions.get(number, 0))
    return versions
