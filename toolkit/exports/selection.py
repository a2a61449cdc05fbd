"""The selected Gaussians of a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError, ToolkitError
from toolkit.base.geometry.image_sides import mean_up
from toolkit.io.splat_labels import INSTANCE, SplatLabels, instances_in
from toolkit.io.splats import read_splats
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.runs.maps.labelled import load_labelled_run
from toolkit.scene.graph.boxes import Ground
from toolkit.scene.graph.storeys import Floors, Storeys
from toolkit.scene.query import FLOOR_NAMES, LabelledMap
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.gaussians.cloud import GaussianCloud

# Minimum opacity of Gaussians that represent surfaces.
MIN_OPACITY = 0.5
# Without labels, the floor is searched below the cameras: the lowest layer of this thickness that
# contains this share of the Gaussians of the fullest layer.
_LAYER_M, _LAYER_SHARE = 0.1, 0.3
# Maximum angle between the vertical of the cameras and the normal of the floor: 30 degrees.
_MIN_COSINE = 0.866


@dataclass(frozen=True)
class SelectedGaussians:
    """The selected Gaussians of a run.

    Attributes:
        run: the run.
        gaussians: N selected Gaussians.
        labels: their labels, or None.
        partial: whether Gaussians were excluded.
        submap: [N] number of the submap of each Gaussian, or None.
        instances: [N] object of each Gaussian, 0 for none; None without instances.
    """

    run: FinishedRun
    gaussians: GaussianCloud
    labels: SplatLabels | None
    partial: bool = False
    submap: NDArray[np.int32] | None = None
    instances: NDArray[np.int32] | None = None

    @property
    def columns(self) -> dict[str, NDArray]:
        """Labels and objects as additional columns of a file."""
        columns = {} if self.labels is None else self.labels.columns()
        return columns if self.instances is None else columns | {INSTANCE: self.instances}

    @property
    def means_m(self) -> NDArray[np.float64]:
        """Centres [N, 3] in metres."""
        return self.gaussians.means.numpy().astype(np.float64)

    @property
    def given_m(self) -> NDArray[np.float64]:
        """Centres [N, 3] in the coordinates of the given poses."""
        return self.means_m + self.run.origin_m

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """Colours [N, 3]."""
        colours = self.gaussians.colours.numpy()
        return np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)

    def opaque(self) -> SelectedGaussians:
        """Return the Gaussians that represent surfaces.

        Raises:
            ToolkitError: there are none.
        """
        mask = self.gaussians.opacities >= MIN_OPACITY
        if not mask.any():
            raise ToolkitError(
                f"{self.run.folder.path}: no selected Gaussian has an opacity of at least "
                f"{MIN_OPACITY}"
            )
        labels = None if self.labels is None else self.labels.select(mask.numpy())
        submap, instances = (
            None if column is None else column[mask.numpy()]
            for column in (self.submap, self.instances)
        )
        return SelectedGaussians(
            self.run, self.gaussians.select(mask), labels, self.partial, submap, instances
        )

    def labelled(self) -> LabelledMap:
        """Return the Gaussians with their labels.

        Raises:
            RunFolderError: the run has no labels.
        """
        if self.labels is None:
            raise RunFolderError(
                f"{self.run.folder.map} has no labels, which this format needs; run SLAM again "
                "with semantics: on a dataset with label images, or with a segmenter"
            )
        axes_m = self.gaussians.axes_m()
        return LabelledMap(self.means_m, self.labels, self._taxonomy(), axes_m)

    @property
    def classes(self) -> dict[int, str]:
        """Class names by id; none if the run has no labels."""
        if self.labels is None:
            return {}
        return dict(enumerate(self._taxonomy().classes, start=1))

    @property
    def class_tree(self) -> dict[str, Any] | None:
        """JSON values of the class tree; None if the run has no labels or no tree."""
        has_tree = self.run.taxonomy is not None or self.run.folder.taxonomy.is_file()
        return self._taxonomy().to_json() if has_tree and self.labels is not None else None

    def _taxonomy(self) -> Taxonomy:
        file = self.run.folder.taxonomy
        if self.run.taxonomy is not None:
            return self.run.taxonomy
        if not file.is_file():
            raise RunFolderError(
                f"{self.run.folder.path} has no {file.name}, which defines the labels of the map; "
                "copy the taxonomy of the run there"
            )
        return Taxonomy.load(file)


def select(run: Path, keep: Sequence[str] = (), drop: Sequence[str] = ()) -> SelectedGaussians:
    """Select the Gaussians of a run by classes and groups.

    Args:
        run: the run folder.
        keep: names of which Gaussians are kept; all if empty.
        drop: names of which Gaussians are excluded.

    Raises:
        ToolkitError: no Gaussian is selected, or classes are given but the map has no labels.
    """
    if not keep and not drop:
        finished = load_run(run)
        splats = read_splats(finished.folder.map)
        return SelectedGaussians(
            finished,
            finished.gaussians,
            splats.labels,
            submap=splats.extra.get("submap"),
            instances=instances_in(splats.extra),
        )
    labelled = load_labelled_run(run)
    mask = labelled.select(keep) if keep else np.ones(len(labelled.map), bool)
    mask &= ~labelled.map.selected(labelled.named(drop))
    if not mask.any():
        raise ToolkitError(f"--keep and --drop exclude all Gaussians of {run}")
    gaussians = labelled.run.gaussians.select(torch.from_numpy(mask))
    submap = read_splats(labelled.run.folder.map).extra.get("submap")
    submap = None if submap is None else submap[mask]
    labels = labelled.map.labels.select(mask)
    return SelectedGaussians(labelled.run, gaussians, labels, True, submap, labels.instances)


def ground_of(run: FinishedRun, names: Sequence[str] = ()) -> Ground | None:
    """Return the floor of a run, or None if it cannot be determined.

    It is fitted to the Gaussians of floor classes, of the lowest storey if there are several.
    Without labels, or if no floor is labelled, it is the lowest full layer of Gaussians below the
    cameras.

    Args:
        names: classes and groups of the floor instead of the common names.
    """
    floors = floors_of(run, names)
    return None if floors is None else floors.ground


def floors_of(run: FinishedRun, names: Sequence[str] = ()) -> Floors | None:
    """Return the floors of all storeys, or None without a floor; see `ground_of`."""
    whole = SelectedGaussians(run, run.gaussians, read_splats(run.folder.map).labels).opaque()
    if whole.labels is not None:
        labelled = whole.labelled()
        for name in names:
            labelled.taxonomy.find(name)  # raises an error if the name does not exist
        floors = labelled.floors(names or FLOOR_NAMES)
        if floors is not None:
            return floors
    ground = _lowest_layer(whole.means_m, run)
    return None if ground is None else Floors(ground, Storeys([ground.height_m]))


def _lowest_layer(means_m: NDArray[np.float64], run: FinishedRun) -> Ground | None:
    if not run.tracked:
        return None
    up = mean_up(run.trajectory.T_world_camera, run.up_side)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    # The cameras are tilted, so a second pass searches along the normal of the first.
    ground = None
    for _ in range(2):
        heights_m = means_m @ up
        layers = np.floor((heights_m - heights_m.min()) / _LAYER_M).astype(int)
        counts = np.bincount(layers)
        lowest = int(np.flatnonzero(counts >= _LAYER_SHARE * counts.max())[0])
        near = np.abs(layers - lowest) <= 1
        if near.all():
            return None
        ground = Ground.below(means_m[near], means_m[~near])
        if ground is None or ground.up @ up < _MIN_COSINE:
            return None
        up = ground.up
    return ground
