"""Start a run in the map of a finished run or of a splat file, and extend it (setting `map`)."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.datasets.base import Dataset
from toolkit.io.splats import is_splat_file
from toolkit.runs.building import build_run_labeller
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.runs.maps.saved_objects import load_objects
from toolkit.runs.maps.splat_map import open_splat_map, summary
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings
from toolkit.scene.instances.listener import InstanceListener
from toolkit.scene.instances.saved import SavedObjects
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)

# Offset between the frame indices of the saved map and of the run, so that no frames of different
# runs are taken for neighbours.
_INDEX_GAP = 10_000


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map that a run starts in.

    Attributes:
        place: the run folder or the splat file.
        submaps: in their order.
        semantics: state of the features' decoder; empty for a map without labels.
        objects: objects of its Gaussians; None without instances.
        source: how a splat file was scaled, for `saved_map.json`; None for the map of a run.
    """

    place: Path
    submaps: Mapping[int, Submap]
    semantics: dict[str, NDArray]
    objects: SavedObjects | None = None
    source: dict[str, Any] | None = None


def open_saved_map(settings: RunSettings, dataset: Dataset | None) -> SavedMap | None:
    """Open the run or the splat file in the setting `map`, None without one.

    Raises:
        ToolkitError: it is no finished run and no splat file, has no submaps, its map cannot be
            extended with these settings, or the dataset does not match the splat file.
    """
    if settings.map is None:
        return None
    if not mode_of(settings).locates or not settings.loops.use:
        raise SettingsError(
            "the setting map requires poses 'slam' and loops.use, because the camera is "
            "relocalised in the saved map"
        )
    if is_splat_file(settings.map):
        found = open_splat_map(settings.map, settings, dataset)
        source = summary(settings.map, found)
        return SavedMap(settings.map, {0: found.submap}, {}, source=source)
    saved = load_run(settings.map)
    saved.version.require_settings(
        settings.map,
        ("loops.features", "semantics"),
        "extended",
        f"--map {saved.folder.map} to extend it as a splat file",
    )
    _check_descriptors(saved, settings)
    _check_semantics(saved, settings, dataset)
    _check_shapes(saved, settings)
    semantics, objects = saved.folder.read_semantics(), load_objects(saved.folder)
    return SavedMap(saved.folder.path, saved.submaps, semantics, objects)


def _check_descriptors(saved: FinishedRun, settings: RunSettings) -> None:
    if not all(submap.descriptors.size for submap in saved.submaps.values()):
        raise SettingsError(
            f"map {settings.map}: the keyframes have no descriptors for place recognition; "
            f"{saved.descriptor_remedy}"
        )
    current, stored = settings.loops.features, saved.settings.loops.features
    if current != stored:
        raise SettingsError(
            f"map {settings.map}: its descriptors (loops.features.kind {stored.kind}, source "
            f"{stored.source}) differ from those of this run ({current.kind}, {current.source}); "
            "set loops.features as in that run"
        )


def _check_semantics(saved: FinishedRun, settings: RunSettings, dataset: Dataset | None) -> None:
    labeller = build_run_labeller(settings, dataset)
    taxonomy = None if labeller is None else labeller.taxonomy
    if (taxonomy is None) != (saved.taxonomy is None):
        state = (
            "has labels, but this run has none"
            if saved.taxonomy
            else "has no labels, but this run has"
        )
        raise SettingsError(f"map {settings.map} {state}; set segmenter.kind as in that run")
    if taxonomy is None or saved.taxonomy is None:
        return
    if taxonomy.digest != saved.taxonomy.digest:
        raise SettingsError(
            f"map {settings.map} has another taxonomy; set semantics.taxonomy to "
            f"{saved.folder.taxonomy}"
        )
    current, stored = settings.semantics, saved.settings.semantics
    if current.code != stored.code or current.network != stored.network:
        raise SettingsError(
            f"map {settings.map} has features of another code; set semantics.code "
            f"({stored.code.kind} in that run) and semantics.network as in that run"
        )


def _check_shapes(saved: FinishedRun, settings: RunSettings) -> None:
    """Check that all Gaussians will have one shape: map.ply has the same columns for all."""
    options = settings.mapping
    shape = "ellipsoids" if saved.gaussians.ellipsoids is not None else "spheres"
    future = options.final_shape if options.final_iterations > 0 else "spheres"
    if shape == future:
        return
    remedy = f"--mapping.final-shape {shape}"
    if options.final_iterations == 0:
        remedy = "a positive --mapping.final-iterations"
    raise SettingsError(
        f"map {settings.map}: its Gaussians are {shape}, and those of this run would be {future}; "
        f"set {remedy}"
    )


def load_saved_map(slam: Slam, saved: SavedMap, folder: RunFolder) -> None:
    """Load a map and the observed classes into a SLAM system, and store where it is from.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    semantics = slam.mapper.semantics
    semantics.restore(saved.semantics)
    submaps = saved.submaps
    last = max(keyframe.index for submap in submaps.values() for keyframe in submap.keyframes)
    _log.info("Relocalising in %d submap(s) of %s.", len(submaps), saved.place)
    if saved.source is not None:
        folder.write_json(folder.saved_map, saved.source)
        _log.info(
            "One unit of the file is %.4g m (%.1f %% between %d located frames).",
            saved.source["metres_per_unit"],
            100.0 * saved.source["relative_spread"],
            len(saved.source["located_frames"]),
        )

    def renumbered() -> Iterator[Submap]:
        for number, submap in enumerate(submaps.values()):
            if saved.source is not None:
                submap = _unlabelled(submap, semantics)
            yield submap.renumbered(number, -last - _INDEX_GAP)

    slam.load_map(renumbered())
    objects = slam.listener(InstanceListener.name)
    if saved.objects is not None and isinstance(objects, InstanceListener):
        objects.tracker.load(saved.objects.renumbered(list(submaps)), -last - _INDEX_GAP)


def _unlabelled(submap: Submap, semantics: SemanticMapping) -> Submap:
    """The submap of a splat file with features, which belong to no class yet."""
    void = semantics.start_values[0].expand(len(submap.gaussians), -1).contiguous()
    return replace(submap, gaussians=replace(submap.gaussians, features=void))
