"""Finished runs with labelled maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, RunFolderError, ToolkitError
from toolkit.io.label_files import label_file_of
from toolkit.io.splats import Splats, read_splats
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.scene.query import LabelledMap, check_labels
from toolkit.semantics.lexicon.matching import Match, selected_nodes
from toolkit.semantics.taxonomy import VOID_NAME, Taxonomy

TAXONOMY = "taxonomy.yaml"


@dataclass(frozen=True)
class LabelledRun:
    """A finished run and the labels of its map."""

    run: FinishedRun
    map: LabelledMap

    def select(self, names: Sequence[str], min_confidence: float = 0.0) -> NDArray[np.bool_]:
        """Return a mask [N] of the Gaussians that belong to any of some classes and groups.

        Args:
            names: names, paths, "void", or nouns that mean classes (`selected_nodes`).
            min_confidence: minimum confidence of a Gaussian.

        Raises:
            FormatError: a name means no class of the taxonomy, or not only this class.
            ToolkitError: a class or group has no Gaussians.
        """
        selected = np.zeros(len(self.map), bool)
        for name in names:
            selected |= self._members(f"'{name}'", self.named([name]), min_confidence)
        return selected

    def named(self, names: Sequence[str]) -> list[str]:
        """Return the paths of the nodes that names and nouns select, and "void" for itself.

        Raises:
            FormatError: as `select`.
        """
        found: list[str] = []
        for name in names:
            void = name.strip().casefold() == VOID_NAME
            nodes = [] if void else selected_nodes([name], self.map.taxonomy)
            found += [VOID_NAME] if void else [str(node) for node in nodes]
        return found

    def select_meant(self, meant: Match, min_confidence: float = 0.0) -> NDArray[np.bool_]:
        """Return a mask [N] of the Gaussians that a text means.

        Raises:
            ToolkitError: there are none.
        """
        reason = f" ({meant.explanation})" if meant.explanation else ""
        return self._members(
            f"'{meant.text}'{reason}", [str(node) for node in meant.nodes], min_confidence
        )

    def _members(self, what: str, nodes: Sequence[str], min_confidence: float) -> NDArray[np.bool_]:
        mask = self.map.selected(nodes, min_confidence)
        if not mask.any():
            confidence = f" with confidence {min_confidence:g} or more" * (min_confidence > 0)
            raise ToolkitError(
                f"{self.run.folder.path} contains no {what}{confidence}; "
                "list its classes with: semsplat query RUN --list"
            )
        return mask


def load_labelled_run(path: Path) -> LabelledRun:
    """Load a finished run with its labels and taxonomy.

    Raises:
        ToolkitError: there is no finished run, its map has no labels, or the taxonomy is missing
            or does not match the labels.
    """
    return label(load_run(path))


def label(run: FinishedRun) -> LabelledRun:
    """Load the labels of a finished run.

    Raises:
        ToolkitError: as `load_labelled_run`.
    """
    path = run.folder.path
    labels = read_splats(run.folder.map).labels
    if labels is None:
        raise RunFolderError(
            f"{run.folder.map} has no labels; run SLAM again with semantics: on a dataset with "
            "label images, or with a segmenter (see: semsplat run --help-all)"
        )
    file = run.folder.taxonomy
    if not file.is_file():
        raise RunFolderError(
            f"{path} has no {TAXONOMY}, which defines the labels of the map; copy the taxonomy of "
            "the run there"
        )
    gaussians = run.gaussians
    means_m, axes_m = gaussians.means.numpy().astype(np.float64), gaussians.axes_m()
    try:
        return LabelledRun(run, LabelledMap(means_m, labels, Taxonomy.load(file), axes_m))
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error


def taxonomy_of_file(path: Path, splats: Splats) -> Taxonomy | None:
    """Return the class tree of the labels of a splat file.

    It is stored in the file or with its labels, or in the folder of the file, as in a run folder.

    Args:
        path: the splat file.
        splats: its content.

    Returns:
        None if the file has no labels, or if their tree is unknown.

    Raises:
        FormatError: the tree is damaged, or is not that of the labels.
    """
    file, labels = path.resolve().parent / TAXONOMY, splats.labels
    if labels is None or (splats.taxonomy is None and not file.is_file()):
        return None
    if splats.taxonomy is not None:
        beside = label_file_of(path)
        taxonomy = Taxonomy.from_json(splats.taxonomy, str(beside if beside.is_file() else path))
    else:
        taxonomy = Taxonomy.load(file)
    try:
        check_labels(labels, taxonomy)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error
    return taxonomy
