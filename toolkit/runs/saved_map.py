"""`semsplat run --map RUN`: begin in the map of a finished run."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from toolkit.datasets.base import Dataset
from toolkit.errors import SettingsError
from toolkit.runs.building import build_run_labeller
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.settings import RunSettings
from toolkit.slam import Slam
from toolkit.submaps.submap import Submap

_log = logging.getLogger(__name__)

# Between the last frame of the saved map and the first one of the run: no neighbours.
_APART = 10_000


def open_saved_map(settings: RunSettings, dataset: Dataset) -> FinishedRun | None:
    """The run that `--map` names, None without one.

    Raises:
        ToolkitError: it is no finished run, left no submaps, or these settings cannot go on
            from it.
    """
    if settings.map is None:
        return None
    if settings.poses != "slam" or not settings.loops.use:
        raise SettingsError(
            "--map looks for the camera in the saved map: it needs --poses slam and --loops.use"
        )
    saved = load_run(settings.map)
    _check_descriptors(saved, settings)
    _check_semantics(saved, settings, dataset)
    return saved


def _check_descriptors(saved: FinishedRun, settings: RunSettings) -> None:
    if not all(submap.descriptors.size for submap in saved.submaps.values()):
        raise SettingsError(
            f"--map {settings.map}: its keyframes have no descriptors, by which places are "
            "recognised; make that map again with --loops.use"
        )
    here, there = settings.loops.features, saved.settings.loops.features
    if here != there:
        raise SettingsError(
            f"--map {settings.map}: its keyframes are described by --loops.features.kind "
            f"{there.kind}, source {there.source}, not by {here.kind}, {here.source}; set "
            "--loops.features as that run did"
        )


def _check_semantics(saved: FinishedRun, settings: RunSettings, dataset: Dataset) -> None:
    labeller = build_run_labeller(settings, dataset)
    tree = None if labeller is None else labeller.taxonomy
    if (tree is None) != (saved.taxonomy is None):
        which, what = ("it has", "have none") if saved.taxonomy else ("it has no", "ask for them")
        raise SettingsError(
            f"--map {settings.map}: {which} labels and these settings {what}; set "
            "--semantics.segmenter.kind as that run did"
        )
    if tree is None or saved.taxonomy is None:
        return
    if tree.digest != saved.taxonomy.digest:
        raise SettingsError(
            f"--map {settings.map}: its labels are of another tree; give "
            f"--semantics.taxonomy {saved.folder.taxonomy}"
        )
    here, there = settings.semantics, saved.settings.semantics
    if here.code != there.code or here.network != there.network:
        raise SettingsError(
            f"--map {settings.map}: its features are of another code; set --semantics.code "
            f"(there {there.code.kind}) and --semantics.network as that run did"
        )


def load_saved_map(slam: Slam, saved: FinishedRun) -> None:
    """Let a system begin in a finished run's map, whose classes it knows from then on.

    Raises:
        ToolkitError: a submap cannot be read.
    """
    slam.mapper.semantics.restore(saved.folder.read_semantics())
    submaps = saved.submaps
    last = max(keyframe.index for submap in submaps.values() for keyframe in submap.keyframes)
    _log.info("looking for the camera in %d submap(s) of %s", len(submaps), saved.folder.path)

    def renumbered() -> Iterator[Submap]:
        for number, submap in enumerate(submaps.values()):
            yield submap.renumbered(number, -last - _APART)

    slam.load_map(renumbered())
