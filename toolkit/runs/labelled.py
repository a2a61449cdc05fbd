"""A finished run whose map knows what its Gaussians are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError, RunFolderError, ToolkitError
from toolkit.io.splats import read_splats
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.semantics.query import LabelledMap
from toolkit.semantics.taxonomy import Taxonomy

TAXONOMY = "taxonomy.yaml"


@dataclass(frozen=True)
class LabelledRun:
    """A finished run and the labels of its map."""

    run: FinishedRun
    map: LabelledMap

    def holding(self, names: Sequence[str], min_confidence: float = 0.0) -> NDArray[np.bool_]:
        """Which Gaussians [N] are of any of these classes and groups.

        Raises:
            FormatError: a name is none of the tree.
            ToolkitError: there is no Gaussian of one of them.
        """
        chosen = np.zeros(len(self.map), bool)
        for name in names:
            mask = self.map.selected([name], min_confidence)
            if not mask.any():
                so_sure = f" with confidence {min_confidence:g} or more" * (min_confidence > 0)
                raise ToolkitError(
                    f"{self.run.folder.path} holds no '{name}'{so_sure}; "
                    "see what there is with: semsplat query RUN --list"
                )
            chosen |= mask
        return chosen


def load_labelled_run(path: Path) -> LabelledRun:
    """Read a run with its labels and their tree.

    Raises:
        ToolkitError: there is no finished run, its map has no labels, the tree is missing or
            is another one.
    """
    run = load_run(path)
    labels = read_splats(run.folder.map).labels
    if labels is None:
        raise RunFolderError(
            f"{run.folder.map} has no labels; map again with them: from a data set with label "
            "images, or with semsplat run --semantics... (see semsplat run --help)"
        )
    file = path / TAXONOMY
    if not file.is_file():
        raise RunFolderError(
            f"{path} has no {TAXONOMY}, without which the labels of its map mean nothing; "
            "put the one there that the run was given"
        )
    means_m = run.gaussians.means.numpy().astype(np.float64)
    try:
        return LabelledRun(run, LabelledMap(means_m, labels, Taxonomy.load(file)))
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error
