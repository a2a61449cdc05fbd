"""Class counts for landmark vectors: labelled pixels, or Gaussians on the visible surface (G-7)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.errors import SettingsError
from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.codes import flat_code
from toolkit.semantics.options import SemanticLossWeights
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.loops.class_counts import GaussianClassCounter, PixelClassCounter
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.loops.options import CandidateOptions, LandmarkOptions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.atlas import Atlas
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.semantic import SemanticLoss
from toolkit.splatting.rendering import backend

NAMES = ["wall", "chair", "table", "lamp"]
CAMERA = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)


def semantics(names) -> SemanticMapping:
    tree = Taxonomy({"everything": list(names)}, classes=names)
    return SemanticMapping(SemanticLoss(flat_code(tree), SemanticLossWeights()))


def grid(x_m: tuple[float, float], z_m: float, class_id: int) -> tuple[torch.Tensor, torch.Tensor]:
    """An opaque plane at depth z, 1 m high, with 25 mm between Gaussians."""
    x = torch.arange(*x_m, 0.025)
    y = torch.arange(-0.5, 0.5, 0.025)
    means = torch.stack([*torch.meshgrid(x, y, indexing="ij")], dim=-1).reshape(-1, 2)
    means = torch.cat([means, torch.full((len(means), 1), z_m)], dim=1)
    return means, torch.full((len(means),), class_id)


def cloud_of(*parts: tuple[torch.Tensor, torch.Tensor]) -> GaussianCloud:
    means, ids = (torch.cat(group) for group in zip(*parts, strict=True))
    count = len(means)
    return GaussianCloud.from_values(
        means=means,
        radii_m=torch.full((count,), 0.02),
        opacities=torch.full((count,), 0.95),
        colours=torch.full((count, 3), 0.5),
        features=semantics(NAMES).start_values.index_select(0, ids),
    )


def keyframe(labels: np.ndarray | None = None) -> Keyframe:
    return Keyframe(
        index=0,
        timestamp_s=0.0,
        T_map_camera=np.eye(4),
        rgb=torch.zeros(3, 30, 40, dtype=torch.uint8),
        depth_m=torch.full((30, 40), 2.0),
        camera=CAMERA,
        exposure=IDENTITY,
        points=np.zeros((0, 3), np.float32),
        class_ids=None if labels is None else torch.from_numpy(labels.astype(np.int16)),
    )


def test_visible_gaussians_are_counted_by_class():
    """Occluded (table), out-of-view (lamp) and unlabelled Gaussians are not counted."""
    wall, chair = grid((-0.5, 0.2), 2.0, 1), grid((0.2, 0.5), 2.0, 2)
    hidden, aside = grid((-0.3, 0.3), 3.0, 3), grid((3.0, 3.5), 2.0, 4)
    unlabelled = grid((0.5, 0.7), 2.0, 0)
    counter = GaussianClassCounter(semantics(NAMES), len(NAMES), backend())
    counts = counter.counts(keyframe(), cloud_of(wall, chair, hidden, aside, unlabelled))
    assert counts.tolist() == [len(wall[0]), len(chair[0]), 0, 0]


def test_all_gaussians_of_a_submap_are_counted_for_equation_7():
    wall, hidden = grid((-0.5, 0.2), 2.0, 1), grid((-0.3, 0.3), 3.0, 3)
    counter = GaussianClassCounter(semantics(NAMES), len(NAMES), backend(), whole=True)
    counts = counter.submap_counts(cloud_of(wall, hidden))
    assert counts is not None
    assert counts.tolist() == [len(wall[0]), 0, len(hidden[0]), 0]


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (LoopClosureOptions(landmarks=LandmarkOptions("paper")), "counted gaussians"),
        (LoopClosureOptions(landmarks=LandmarkOptions("linear")), "threshold fixed"),
    ],
)
def test_options_of_landmarks_without_effect_are_rejected(options, remedy):
    with pytest.raises(SettingsError, match=remedy):
        build_loop_closer(options, ClosingContext(0, "auto", SemanticMapping(), None))


def test_labelled_pixels_are_counted_without_the_map():
    labels = np.zeros((30, 40), int)
    labels[:10], labels[10:15] = 3, 1
    counter = PixelClassCounter(len(NAMES))
    assert counter.counts(keyframe(labels), GaussianCloud.empty()).tolist() == [200, 0, 400, 0]
    assert counter.counts(keyframe(), GaussianCloud.empty()).tolist() == [0] * 4


@pytest.fixture(scope="module")
def labelled_frame():
    frames, _ = tiny_room(1, 64, 48)
    return frames[0]


@pytest.mark.parametrize("counted", ["pixels", "gaussians"])
def test_the_setting_decides_what_loop_detection_counts(labelled_frame, counted):
    reading = semantics(CLASS_NAMES)
    taxonomy = Taxonomy({"everything": list(CLASS_NAMES)}, classes=CLASS_NAMES)
    mapper = Mapper(MapperOptions(first_iterations=1), semantics=reading)
    atlas = Atlas(mapper.first_submap())
    mapper.add_keyframe(atlas.current, Keyframe.from_frame(labelled_frame, np.eye(4)))
    settings = LoopClosureOptions(
        candidates=CandidateOptions(threshold="fixed"), landmarks=LandmarkOptions(counted=counted)
    )
    closer = build_loop_closer(settings, ClosingContext(0, "auto", reading, taxonomy))
    closer.keyframe_added(atlas)
    counter = {
        "pixels": PixelClassCounter(len(taxonomy)),
        "gaussians": GaussianClassCounter(reading, len(taxonomy), backend()),
    }[counted]
    expected = counter.counts(atlas.keyframes[0], atlas.gaussians)
    assert closer.state()[0]["detector/class_counts"].tolist() == [expected.tolist()]
    others = PixelClassCounter(len(taxonomy)).counts(atlas.keyframes[0], atlas.gaussians)
    assert (expected.tolist() == others.tolist()) is (counted == "pixels")
