"""The votes of keyframes tell labels that agree from ids that change in every frame."""

from dataclasses import replace

import numpy as np
import pytest
from slam_room import first_steps, new_semantic_slam

from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES


@pytest.fixture(scope="module")
def frames():
    return first_steps(9).frames


def agreement(frames):
    slam = new_semantic_slam("recorded")
    for frame in frames:
        slam.process_frame(frame)
    return slam.finish().label_agreement


def permuted(frame):
    ids = np.random.default_rng(frame.index).permutation(len(CLASS_NAMES)) + 1
    return replace(frame, labels=np.append(0, ids).astype(np.int32)[frame.labels])


def test_ids_of_masks_without_tracking_are_found_by_the_votes(frames):
    right, wrong = agreement(frames), agreement([permuted(frame) for frame in frames])
    assert right.compared > 1000 and right.changed_share < 0.05 and right.findings == ()
    assert wrong.changed_share > 0.6
    (line,) = wrong.findings
    assert f"changed {wrong.changed_share:.0%} of the labelled pixels" in line
