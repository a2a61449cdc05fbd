"""Segmentation figures against scikit-learn and torchmetrics, and what they leave out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix, jaccard_score

from toolkit.runs.evaluation.frame_costs import gaussian_bytes
from toolkit.runs.evaluation.segmentation import (
    Segmentation,
    class_iou,
    confusion,
    score,
    segmentation_metrics,
    visible_classes,
)
from toolkit.semantics.taxonomy import Taxonomy

TREE = Taxonomy(
    {
        "large": {"soft": ["bed", "sofa"], "hard": ["table", "desk"]},
        "small": {"dishes": ["cup", "plate"], "toys": ["ball"]},
        "wall": {},
    },
    levels=["size", "kind", "class"],
)
CLASSES = len(TREE)


def images(seed: int, views: int = 1, right: float = 0.7) -> list[tuple[np.ndarray, np.ndarray]]:
    """Truth and prediction with void in both and a class that never appears."""
    generator = np.random.default_rng(seed)
    made = []
    for _ in range(views):
        truth = generator.choice([0, 1, 2, 3, 5, 7, 8], (12, 16))
        guess = generator.choice([0, 1, 2, 3, 5, 7, 8], (12, 16))
        made.append((truth, np.where(generator.uniform(size=truth.shape) < right, truth, guess)))
    return made


def evaluated(pairs) -> Segmentation:
    result = Segmentation(TREE)
    for truth, predicted in pairs:
        result.add(truth, predicted)
    return result


@given(st.integers(0, 10_000), st.integers(1, 3), st.floats(0.0, 1.0))
def test_figures_are_those_of_scikit_learn(seed, views, right):
    pairs = images(seed, views, right)
    truth, predicted = (np.concatenate([p[i].ravel() for p in pairs]) for i in range(2))
    result = evaluated(pairs)
    labels = np.arange(CLASSES + 1)
    np.testing.assert_array_equal(
        result.counts(), confusion_matrix(truth, predicted, labels=labels)
    )
    kept = truth != 0
    appears = np.setdiff1d(np.union1d(truth[kept], predicted[kept]), [0])
    metrics = segmentation_metrics(result)
    expected = jaccard_score(truth[kept], predicted[kept], labels=appears, average="macro")
    assert metrics["miou_percent"] == pytest.approx(100.0 * expected)
    shares = np.bincount(truth[kept], minlength=9)[appears] / kept.sum()
    each = jaccard_score(truth[kept], predicted[kept], labels=appears, average=None)
    assert metrics["fwiou_percent"] == pytest.approx(100.0 * (shares * each).sum())
    assert metrics["accuracy_percent"] == pytest.approx(100.0 * (truth == predicted)[kept].mean())
    with_void = np.union1d(truth, predicted)
    expected = jaccard_score(truth, predicted, labels=with_void, average="macro")
    assert metrics["miou_with_void_percent"] == pytest.approx(100.0 * expected)
    assert metrics["accuracy_with_void_percent"] == pytest.approx(
        100.0 * (truth == predicted).mean()
    )
    assert metrics["labelled_percent"] == pytest.approx(100.0 * kept.mean())


@given(st.integers(0, 10_000), st.integers(0, 2))
def test_a_level_is_scored_as_its_groups_are(seed, level):
    pairs = images(seed, 2)
    groups = [tuple(TREE.level_ids(image, level).ravel() for image in pair) for pair in pairs]
    truth, predicted = (np.concatenate([g[i] for g in groups]) for i in range(2))
    kept = truth != -1
    appears = np.setdiff1d(np.union1d(truth[kept], predicted[kept]), [-1])
    metrics = segmentation_metrics(evaluated(pairs))
    expected = jaccard_score(truth[kept], predicted[kept], labels=appears, average="macro")
    assert metrics[f"level_{level}"]["miou_percent"] == pytest.approx(100.0 * expected)
    right = (truth == predicted)[kept].mean()
    assert metrics[f"level_{level}"]["accuracy_percent"] == pytest.approx(100.0 * right)


def test_figures_per_class_are_those_of_torchmetrics():
    functional = pytest.importorskip("torchmetrics.functional.classification")
    import torch

    (truth, predicted), *_ = images(3)
    each = functional.multiclass_jaccard_index(
        torch.from_numpy(predicted),
        torch.from_numpy(truth),
        num_classes=CLASSES + 1,
        average=None,
    )
    ours = class_iou(confusion(truth, predicted, CLASSES), with_void=True)
    appears = np.isfinite(ours)
    assert appears.sum() == 7
    np.testing.assert_allclose(ours[appears], each.numpy()[appears], rtol=1e-6)


def test_means_over_views_differ_from_those_over_the_sequence():
    first = np.full((4, 4), 1), np.full((4, 4), 1)
    second = np.full((2, 2), 1), np.full((2, 2), 2)
    metrics = segmentation_metrics(evaluated([first, second]))
    # Class 1: 16 hits of 20; class 2: none of 4.
    assert metrics["miou_union_percent"] == pytest.approx(100.0 * (16 / 20 + 0.0) / 2)
    assert metrics["miou_per_view_percent"] == pytest.approx(100.0 * (1.0 + 0.0) / 2)
    # Both are soft and large.
    assert metrics["level_1"]["miou_percent"] == 100.0
    assert metrics["level_0"]["miou_per_view_percent"] == 100.0


def test_a_wrong_class_hurts_the_mean_but_not_the_mean_over_visible_classes():
    truth = np.array([[1, 1, 1, 0]])
    predicted = np.array([[1, 1, 5, 5]])
    metrics = segmentation_metrics(evaluated([(truth, predicted)]))
    assert metrics["miou_union_percent"] == pytest.approx(100.0 * (2 / 3 + 0.0) / 2)
    assert metrics["miou_visible_percent"] == pytest.approx(100.0 * 2 / 3)
    assert metrics["miou_subset_percent"] is None


def test_the_subset_figure_takes_predictions_among_visible_classes():
    truth = np.array([[1, 1, 3, 0]])
    result = Segmentation(TREE)
    assert visible_classes(truth).tolist() == [1, 3]
    result.add(truth, np.array([[1, 5, 3, 5]]), subset=np.array([[1, 3, 3, 1]]))
    metrics = segmentation_metrics(result)
    assert metrics["miou_subset_percent"] == pytest.approx(100.0 * (1 / 2 + 1 / 2) / 2)
    assert metrics["miou_visible_percent"] == pytest.approx(100.0 * (1 / 2 + 1) / 2)


def test_predicted_levels_may_disagree_and_back_off():
    truth = np.array([[1, 5]])
    nodes = np.stack([TREE.level_ids(truth, level) for level in range(3)])
    result = Segmentation(TREE)
    result.add(truth, nodes)
    assert segmentation_metrics(result)["miou_percent"] == 100.0
    # Unsure of the class, and wrong about the kind.
    nodes[2, 0, 0] = -1
    nodes[1, 0, 1] = TREE.node_ids[6, 1]
    unsure = Segmentation(TREE)
    unsure.add(truth, nodes)
    metrics = segmentation_metrics(unsure)
    assert metrics["level_0"]["miou_percent"] == 100.0
    assert metrics["level_1"]["miou_percent"] == pytest.approx(100.0 * (1 + 0) / 2)
    assert metrics["level_2"]["miou_percent"] == pytest.approx(100.0 * (0 + 1) / 2)


def test_what_does_not_exist_is_none():
    metrics = segmentation_metrics(Segmentation(TREE))
    assert metrics["miou_percent"] is None
    assert metrics["level_0"]["miou_percent"] is None
    assert metrics["views"] == 0
    only_void = evaluated([(np.zeros((2, 2), int), np.ones((2, 2), int))])
    assert segmentation_metrics(only_void)["miou_percent"] is None
    assert segmentation_metrics(only_void)["miou_per_view_percent"] is None
    assert segmentation_metrics(only_void)["miou_with_void_percent"] == 0.0
    assert score(only_void.counts()).classes == 0


@pytest.mark.parametrize(
    ("truth", "predicted", "message"),
    [
        (np.zeros((2, 2), int), np.zeros((2, 3), int), "the same shape"),
        (np.full((2, 2), 9), np.zeros((2, 2), int), r"within 0\.\.8"),
        (np.full((2, 2), -1), np.zeros((2, 2), int), r"within 0\.\.8"),
        (np.zeros((2, 2), int), np.zeros((2, 2, 2), int), r"\[3, H, W\]"),
        (np.zeros((2, 2), int), np.full((3, 2, 2), 99), "node indices"),
        (np.zeros((2, 2), int), np.full((3, 2, 2), 1), "not at level 0"),
    ],
)
def test_images_of_another_tree_or_size_are_refused(truth, predicted, message):
    with pytest.raises(ValueError, match=message):
        Segmentation(TREE).add(truth, predicted)


def test_storage_counts_floats_of_four_bytes():
    assert gaussian_bytes(0) == 32
    assert gaussian_bytes(26) == 32 + 104
