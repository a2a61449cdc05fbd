"""Start a run in the map of a finished run, which is extended (setting `map`)."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from toolkit.datasets.base import Dataset
from toolkit.errors import SettingsError
from toolkit.runs.building import build_run_labeller
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings
from toolkit.slam.system import Slam
from toolkit.submaps.submap import Submap

_log = logging.getLogger(__name__)

# Offset between the frame indices of the saved map and of the run, so that no frames of different
# runs are taken for neighbours.
_INDEX_GAP = 10_000


def open_saved_map(settings: RunSettings, dataset: Dataset | None) -> FinishedRun | None:
    """Open the run in the setting `map`, None without one.

    Raises:
        ToolkitError: it is not a finished run, has no submaps, or its map cannot be extended with
            these settings.
    """
    if settings.map is None:
        return None
    if not mode_of(settings).locates or not settings.loops.use:
        raise SettingsError(
            "the setting map requires poses 'slam' and loops.use, because the camera is "
            "relocalised in the saved map"
        )
    saved = load_run(settings.map)
    _check_descriptors(saved, settings)
    _check_semantics(saved, settings, dataset)
    return saved


def _check_descriptors(saved: FinishedRun, settings: RunSettings) -> None:
    if not all(submap.descriptors.size for submap in saved.submaps.values()):
        raise SettingsError(
            f"map {settings.map}: the keyframes have no descriptors for place recognition; create "
            "this map again with loops.use"
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


def load_saved_map(slam: Slam, saved: FinishedRun) -> None:
    """Load the map and the observed classes of a finished run into a SLAM system.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    slam.mapper.semantics.restore(saved.folder.read_semantics())
    submaps = saved.submaps
    last = max(keyframe.index for submap in submaps.values() for keyframe in submap.keyframes)
    _log.info("Relocalising in %d submap(s) of %s.", len(submaps), saved.folder.path)

    def renumbered() -> Iterator[Submap]:
        for number, submap in enumerate(submaps.values()):
            yield submap.renumbered(number, -last - _INDEX_GAP)

    slam.load_map(renumbered())
