"""Runs with models in the format of `transformers` that are made here, with random weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from killed_runs import kept_checkpoints

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.io.arrays import arrays_below, read_array_tree
from toolkit.runs.evaluation.metrics import read_metrics
from toolkit.runs.evaluation.run_loops import accepted_edges
from toolkit.semantics.features.factory import build_encoder
from toolkit.semantics.features.options import FeatureOptions
from toolkit.slam.loops.log import read_loop_log
from toolkit.slam.loops.retrieval import DescriptorIndex
from toolkit.tools.cli.main import main

pytest.importorskip("transformers")

# What each frame of the recording shows: the camera returns on the same path.
WAY = [*range(9), *range(7, -1, -1)]
QUICK = [
    *("--mapping.first-iterations", "8"),
    *("--mapping.iterations", "3"),
    *("--mapping.final-iterations", "1"),
    *("--mapping.keyframes.interval", "1"),
]
SEARCH = [
    *("--loops.candidates.min-gap-frames", "8"),
    *("--loops.candidates.min-gap-m", "0.05"),
    *("--loops.candidates.search-every", "2"),
]


@pytest.fixture(scope="module")
def returning(tmp_path_factory) -> Path:
    """The recording of a camera that returns to its start."""
    frames, truth = tiny_room(9, 96, 72)
    folder = tmp_path_factory.mktemp("returning") / "recording"
    prepare_folder(folder)
    shown = [replace(frames[i], index=k, timestamp_s=k / 30) for k, i in enumerate(WAY)]
    write_sequence(folder, shown, frames[0].camera, truth.T_world_camera[WAY])
    return folder


def run(recording: Path, out: Path, *more: str) -> None:
    data = ["--dataset.kind", "synthetic", "--dataset.path", str(recording)]
    assert main(["run", *data, *QUICK, *more, "--out", str(out)]) == 0


def test_a_run_finds_and_accepts_a_loop_by_a_vision_transformer(returning, tiny_dinov2, tmp_path):
    kind = ["--loops.features.kind", "dinov2", "--loops.features.folder", str(tiny_dinov2)]
    with kept_checkpoints():
        run(returning, tmp_path / "run", *SEARCH, *kind)

    # The search index has the descriptors of this model, one for each frame.
    newest = max((tmp_path / "run" / "checkpoint").iterdir())
    stored = arrays_below(read_array_tree(newest).arrays, "closer/detector/")["descriptors"]
    assert stored.shape == (len(WAY), 16)
    options = FeatureOptions(kind="dinov2", folder=tiny_dinov2)
    encoder = build_encoder(options)
    frames, truth = tiny_room(9, 96, 72)
    shown = torch.from_numpy(np.stack([frames[i].rgb for i in WAY])).permute(0, 3, 1, 2)
    shown = (shown * 255.0).round() / 255.0
    np.testing.assert_allclose(stored, encoder.describe(shown).numpy(), atol=1e-4)
    index = DescriptorIndex.from_state({"descriptors": stored}, 16)
    assert index.search(stored[15], 1, among=range(8))[0].keyframe == WAY[15]

    # Candidates are the frames nearest to it. One of them was accepted, at its true place.
    records = read_loop_log(tmp_path / "run" / "loops.jsonl")
    candidates = {(r["query"], r["match"]): r for r in records if r["kind"] == "candidate"}
    for (query, match), record in candidates.items():
        apart = np.linalg.norm(stored[query] - stored[match])
        assert record["distance"] == pytest.approx(apart, abs=1e-4)
    edges = [edge for edge in accepted_edges(records) if "T_match_query" in edge]
    assert edges
    for edge in edges:
        assert candidates[edge["query"], edge["match"]]["accepted"]
        match, query = (truth.T_world_camera[WAY[edge[k]]] for k in ("match", "query"))
        error = se3.inverse(np.reshape(edge["T_match_query"], (4, 4))) @ se3.inverse(match) @ query
        assert np.linalg.norm(error[:3, 3]) < 0.02


def test_a_run_maps_the_classes_of_a_head_on_a_vision_transformer(returning, tiny_dinov2, tmp_path):
    data = ["--dataset.kind", "synthetic", "--dataset.path", str(returning)]
    head = tmp_path / "head.safetensors"
    model = ["--model", str(tiny_dinov2), "--longest-side", "96"]
    assert main(["train-head", *data, *model, "--out", str(head)]) == 0
    segmenter = ["--segmenter.kind", "model", "--segmenter.model.folder", str(tiny_dinov2)]
    segmenter += ["--segmenter.model.head", str(head)]
    run(returning, tmp_path / "run", *segmenter)

    found = read_metrics(tmp_path / "run" / "metrics.json")["semantics"]["mapped"]
    frames, _ = tiny_room(9, 96, 72)
    counts = np.bincount(np.concatenate([frames[i].labels.ravel() for i in WAY]))
    assert found["views"] == len(WAY)
    # More than the most frequent class alone.
    assert found["accuracy_percent"] > 100.0 * counts.max() / counts.sum() + 10.0
    assert found["miou_percent"] > 20.0
