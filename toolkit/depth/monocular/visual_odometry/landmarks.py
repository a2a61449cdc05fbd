"""Landmarks of visual odometry: features with the keyframes that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.bundle_adjustment.problem import BundleProblem, Landmarks, Observations
from toolkit.semantics.features.tracks import Features

Array = NDArray[np.float64]

# Information of an inverse depth that is held.
_HELD = 1e12
# Standard deviation of an assumed inverse depth relative to it.
_ASSUMED_SIGMA = 0.5


@dataclass
class OdometryView:
    """A keyframe of the odometry.

    Attributes:
        frame: number of the image. T_world_camera: [4, 4]. features: image points in it.
    """

    frame: int
    T_world_camera: Array
    features: Features


class LandmarkTable:
    """Anchors and inverse depths by the identity of features, which grows.

    Attributes:
        anchor: [N] number of the view that shows the landmark first.
        px: [N, 2] pixel there.
        inverse_depth: [N] measured or, before there is parallax, assumed; 0 for features that are
            not landmarks.
        measured: [N] whether it follows from parallax.
    """

    def __init__(self) -> None:
        self.anchor = np.zeros(0, np.int32)
        self.px = np.zeros((0, 2))
        self.inverse_depth = np.zeros(0)
        self.measured = np.zeros(0, bool)

    def add(self, view: int, features: Features) -> None:
        """Add the features that a view shows first; their identities follow the last ones."""
        new = features.ids >= len(self.anchor)
        count = int(new.sum())
        if not count:
            return
        assert (features.ids[new] == len(self.anchor) + np.arange(count)).all()
        self.anchor = np.concatenate([self.anchor, np.full(count, view, np.int32)])
        self.px = np.concatenate([self.px, features.px[new]])
        self.inverse_depth = np.concatenate([self.inverse_depth, np.zeros(count)])
        self.measured = np.concatenate([self.measured, np.zeros(count, bool)])

    def append(
        self, anchor: NDArray[np.int32], px: Array, inverse_depth: Array
    ) -> NDArray[np.int64]:
        """Add measured landmarks [N]; returns their identities [N]."""
        ids = len(self.anchor) + np.arange(len(anchor))
        self.anchor = np.concatenate([self.anchor, anchor.astype(np.int32)])
        self.px = np.concatenate([self.px, px])
        self.inverse_depth = np.concatenate([self.inverse_depth, inverse_depth])
        self.measured = np.concatenate([self.measured, np.ones(len(anchor), bool)])
        return ids

    def extend(self, other: LandmarkTable, first_view: int) -> None:
        """Add the landmarks of another map, whose first view has the number `first_view` here."""
        self.anchor = np.concatenate([self.anchor, other.anchor + np.int32(first_view)])
        self.px = np.concatenate([self.px, other.px])
        self.inverse_depth = np.concatenate([self.inverse_depth, other.inverse_depth])
        self.measured = np.concatenate([self.measured, other.measured])

    def copy(self) -> LandmarkTable:
        """An independent copy."""
        other = LandmarkTable()
        other.anchor, other.px = self.anchor.copy(), self.px.copy()
        other.inverse_depth, other.measured = self.inverse_depth.copy(), self.measured.copy()
        return other

    def assume(self, ids: NDArray[np.int64], inverse_depth: Array) -> None:
        """Make landmarks of those features [N] that are none yet, at assumed inverse depths [N]."""
        new = self.inverse_depth[ids] == 0
        self.inverse_depth[ids[new]] = inverse_depth[new]

    def prior(self, ids: NDArray[np.int64]) -> Array:
        """Expected inverse depths and their information [L, 2] for a bundle adjustment."""
        expected = self.inverse_depth[ids]
        information = np.where(
            self.measured[ids], 0.0, 1.0 / np.maximum(_ASSUMED_SIGMA * expected, 1e-9) ** 2
        )
        return np.stack([expected, information], 1)


def bundle(
    camera: Camera,
    table: LandmarkTable,
    views: Sequence[OdometryView],
    window: Sequence[int],
    free: Sequence[int],
) -> tuple[BundleProblem, NDArray[np.int64], NDArray[np.intp]]:
    """The bundle adjustment of some views.

    Args:
        window: numbers of the views whose image points count.
        free: numbers of those whose poses change. Anchors outside the window are held.

    Returns:
        The problem, the identities [L] of its landmarks, and the views [P] of its poses.
    """
    ids = np.concatenate([views[n].features.ids for n in window])
    px = np.concatenate([views[n].features.px for n in window])
    view = np.concatenate([np.full(len(views[n].features), n) for n in window])
    use = (table.inverse_depth[ids] > 0) & (table.anchor[ids] != view)
    ids, px, view = ids[use], px[use], view[use]
    order = np.lexsort((view, ids))
    ids, px, view = ids[order], px[order], view[order]
    landmarks, landmark = np.unique(ids, return_inverse=True)
    anchors = table.anchor[landmarks]
    poses = np.unique(np.concatenate([view, anchors]))
    place = np.full(len(views), -1)
    place[poses] = np.arange(len(poses))
    inverse_depth = table.inverse_depth[landmarks]
    problem = BundleProblem(
        camera,
        np.array([views[n].T_world_camera for n in poses]).reshape(-1, 4, 4),
        ~np.isin(poses, free),
        Landmarks(
            place[anchors].astype(np.int32),
            table.px[landmarks],
            inverse_depth,
            table.prior(landmarks),
        ),
        Observations(landmark.astype(np.int32), place[view].astype(np.int32), px),
    )
    return problem, landmarks, poses


def held(problem: BundleProblem) -> BundleProblem:
    """The same problem with all measured inverse depths held."""
    prior = problem.landmarks.prior.copy()
    prior[prior[:, 1] == 0, 1] = _HELD
    return replace(problem, landmarks=replace(problem.landmarks, prior=prior))
