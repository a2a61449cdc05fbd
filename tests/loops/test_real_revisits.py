"""Loop detection on a real recording: a kitchen traversed in both directions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.geometry.frustum import far_depth_m, observed_points
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.loops import LoopTruthOptions, TrueViews, score_loops
from toolkit.semantics.features.vlad import VladEncoder
from toolkit.slam.loops.candidates import CandidateFinder, DescribedKeyframe
from toolkit.slam.loops.options import CandidateOptions

pytest.importorskip("faiss")

EVERY = 8  # frames per keyframe
NO_CLASSES = np.zeros(0, np.int64)


@pytest.fixture
def kitchen(real_data):
    """Every eighth frame of the recording."""
    dataset = open_dataset("seven-scenes", real_data("7scenes_redkitchen"), (160, 120))
    return [dataset[i] for i in range(0, len(dataset), EVERY)], dataset


def test_return_path_is_recognised(kitchen):
    frames, dataset = kitchen
    truth = dataset.ground_truth
    poses = np.array([truth.at(frame.timestamp_s) for frame in frames])
    steps_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1)
    encoder = VladEncoder()
    options = CandidateOptions(search_every=1, min_gap_frames=4)
    finder = CandidateFinder(encoder.dimensions, encoder.threshold, options)
    accepted = []
    for number, frame in enumerate(frames):
        image = torch.from_numpy(frame.rgb).permute(2, 0, 1)[None]
        descriptor = encoder.describe(image)[0].numpy()
        travelled_m = float(steps_m[: number + 1].sum())
        found = finder.add(DescribedKeyframe(number, 0, travelled_m, descriptor, NO_CLASSES))
        accepted += [(c.query, c.match) for c in found if c.accepted]

    views = TrueViews(
        dataset.camera,
        poses,
        np.stack([observed_points(dataset.camera, f.depth_m, 300) for f in frames]),
        np.array([far_depth_m(f.depth_m) for f in frames]),
    )
    strict = LoopTruthOptions(min_gap_frames=4)
    score = score_loops(views, range(len(frames)), accepted, strict)
    assert score.with_loop >= 8
    # Verification decides: candidates by rank are true or not, but hardly any loop is missed.
    assert score.recall > 0.7
