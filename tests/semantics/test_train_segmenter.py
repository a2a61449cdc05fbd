"""Training of the indoor segmenter: rooms, sensors, batches, and states to continue from."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.train_segmenter import Training, class_loss, export, summary
from data_tools.training_rooms.rooms import FAMILIES, random_room
from data_tools.training_rooms.samples import CLASS_IDS, TrainingBatches, batch, sample
from data_tools.training_rooms.sensors import measured
from data_tools.training_rooms.views import RenderedRoom, training_views
from toolkit.semantics.segmenters.indoor.channels import COUNT
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES
from toolkit.semantics.segmenters.indoor.network import load_weights


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_shows_what_it_is_made_of(family):
    rng = np.random.default_rng(5)
    rooms = [random_room(rng, family) for _ in range(3)]
    names = {solid.name for room in rooms for solid in room.piece}
    assert {"floor", "wall", "ceiling"} < names <= set(INDOOR_CLASSES)
    views = list(islice(training_views(rng, CLASS_IDS, (80, 60), 3, family), 6))
    assert all(view.labels.shape == view.depth_m.shape == (60, 80) for view in views)
    assert len(np.unique(np.stack([view.labels for view in views]))) > 4


def test_furniture_stays_inside_the_walls():
    for seed in range(8):
        room = random_room(np.random.default_rng(seed))
        width, depth, height = room.size_m
        inside = [s for s in room.piece if s.name in ("table", "sofa", "bed", "cabinet")]
        for solid in inside:
            low, high = solid.vertices_m.min(axis=0), solid.vertices_m.max(axis=0)
            assert (low > -0.3).all()
            assert (high < np.array([width, depth, height]) + 0.3).all()


def test_the_floor_is_where_the_view_says():
    rng = np.random.default_rng(3)
    rendered = RenderedRoom(random_room(rng, "living"), CLASS_IDS)
    view = next(v for v in (rendered.view(rng, 80, 60) for _ in range(50)) if v is not None)
    points = view.camera.unproject(view.depth_m)
    world = points @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    floor = (view.labels == CLASS_IDS["floor"]) & (view.depth_m > 0)
    if floor.any():
        assert abs(np.median(world[..., 2][floor])) < 0.1
    assert world[..., 2][view.depth_m > 0].max() < rendered.room.size_m[2] + 0.5


def test_sensors_measure_near_the_truth_or_nothing():
    depth = np.full((60, 80), 2.0, np.float32)
    depth[:, 40:] = 3.0
    depth[:5] = 0.0
    cosine, dark = np.ones((60, 80), np.float32), np.zeros((60, 80), bool)
    for seed in range(40):
        found = measured(np.random.default_rng(seed), depth, cosine, dark)
        assert found.dtype == np.float32 and (found[:5] == 0.0).all()
        there = found > 0
        assert there.any()
        error = np.abs(found - depth)[there]
        assert np.quantile(error, 0.8) < 0.25


def test_a_batch_depends_on_its_number_alone():
    first = list(islice(iter(TrainingBatches(7, 0, 2)), 4))
    later = next(iter(TrainingBatches(7, 2, 2)))
    mirrored = next(iter(TrainingBatches(7, 3, 2)))
    other = next(iter(TrainingBatches(8, 2, 2)))
    for one, two in zip(first[2], later, strict=True):
        assert torch.equal(one, two)
    for one, mirror, two in zip(first[2], first[3], mirrored, strict=True):
        assert torch.equal(one.flip(-1), mirror) and torch.equal(mirror, two)
    assert first[2][0].shape != other[0].shape or not torch.equal(first[2][0], other[0])
    assert first[0][0].shape[1] == COUNT and first[0][0].dtype == torch.float16


def test_labels_are_those_of_cells_with_depth():
    rng = np.random.default_rng(2)
    channels, labels = sample(rng, next(training_views(rng, CLASS_IDS, (80, 60), 1)))
    assert channels.shape[1:] == labels.shape == (64, 80)
    assert (labels[channels[6] == 0] == 0).all()
    assert set(np.unique(labels)) <= set(range(len(INDOOR_CLASSES) + 1))


def test_rare_classes_and_right_groups_count():
    frequency = torch.full((len(INDOOR_CLASSES),), 0.01)
    labels = torch.tensor([[[CLASS_IDS["table"]]]])

    def loss(name: str) -> float:
        logits = torch.zeros(1, len(INDOOR_CLASSES), 1, 1)
        logits[0, CLASS_IDS[name] - 1] = 4.0
        return float(class_loss(logits, labels, frequency))

    assert loss("table") < loss("desk") < loss("plant")
    assert float(class_loss(torch.zeros(1, 22, 1, 1), 0 * labels, frequency)) == 0.0


def test_training_learns_one_batch():
    training = Training(100, 0, rate=3e-3)
    channels, labels = batch(np.random.default_rng(0), 2)
    channels, labels = channels[..., :48, :48], labels[..., :48, :48]
    losses = [training.learn(channels, labels) for _ in range(20)]
    assert losses[-1] < 0.9 * losses[0]


def test_a_training_continues_from_its_state(tmp_path):
    def steps(training: Training, numbers: range) -> None:
        for number in numbers:
            torch.manual_seed(number)
            training.learn(torch.randn(2, COUNT, 32, 32), torch.randint(0, 23, (2, 32, 32)))

    whole, first, second = (Training(10, 1) for _ in range(3))
    steps(whole, range(4))
    steps(first, range(2))
    first.save(tmp_path / "state.pt")
    second.restore(tmp_path / "state.pt")
    steps(second, range(2, 4))
    assert second.step == 4
    for one, two in zip(whole.average.values(), second.average.values(), strict=True):
        assert torch.equal(one, two)


def test_exported_weights_are_the_averages(tmp_path, monkeypatch):
    monkeypatch.setattr("data_tools.train_segmenter._ROOMS", 1)
    training = Training(10, 1)
    for _ in range(2):
        training.learn(torch.randn(2, COUNT, 32, 32), torch.randint(0, 23, (2, 32, 32)))
    export(training, tmp_path / "w.safetensors")
    weights = load_weights(tmp_path / "w.safetensors")
    image = torch.randn(COUNT, 32, 32)
    with torch.no_grad():
        expected = torch.log_softmax(training.averaged()(image[None])[0], dim=0)
        torch.testing.assert_close(weights.log_probabilities(image), expected, atol=0.02, rtol=0.02)
    # Walls are not floors, whatever the network says.
    assert weights.structure.shape == (6, len(INDOOR_CLASSES))
    floor, wall = INDOOR_CLASSES.index("floor"), INDOOR_CLASSES.index("wall")
    assert weights.structure[1, floor] > weights.structure[1, wall]


def test_a_summary_has_iou_of_every_class():
    matrix = torch.diag(torch.full((len(INDOOR_CLASSES),), 10.0))
    matrix[0, 1] = 10.0
    found = summary(matrix)
    assert found["floor"] == pytest.approx(50.0) and found["ceiling"] == pytest.approx(100.0)
    assert found["accuracy"] == pytest.approx(100.0 * 220 / 230)


def test_the_program_writes_weights(tmp_path):
    words = ["w.safetensors", "--state", "s.pt", "--steps", "0", "--workers", "0"]
    code = (
        "import data_tools.train_segmenter as t; t._ROOMS = t._VALIDATION_BATCHES = 1; "
        "t._BATCH = 1; t.main()"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=tmp_path, env=_environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "mIoU" in run.stdout and (tmp_path / "s.pt").exists()
    load_weights(tmp_path / "w.safetensors")


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
