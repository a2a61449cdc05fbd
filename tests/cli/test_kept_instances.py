"""Maps that are continued, merged and refined keep the objects of their Gaussians."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_runs import make_recordings, walk
from scipy.spatial import cKDTree
from test_semantic_runs import error_of

from toolkit.io.object_embeddings import read_objects, write_objects
from toolkit.io.splats import read_splats
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.saved_objects import load_objects
from toolkit.tools.cli.main import main

FAST = ["--registration.views", "4"]
GEOMETRIC = ["--instances.kind", "geometric"]


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """Two runs through one room, with objects, and their recordings."""
    folder = tmp_path_factory.mktemp("walks")
    recordings, _ = make_recordings(folder, 96, 72)
    for name, recording in zip("ab", recordings, strict=True):
        assert main(walk(recording, folder / name, *GEOMETRIC)) == 0
    with_embeddings(folder / "a")
    return folder / "a", folder / "b", recordings


def with_embeddings(run: Path) -> None:
    """Give the objects of a run embeddings, as those of masks."""
    saved = load_objects(RunFolder(run))
    assert saved is not None
    objects = np.array([one.number for one in saved.objects], np.int32)
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(len(objects), 8))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    np.savez(
        run / "objects.npz",
        ids=objects,
        instances=objects,
        class_ids=np.zeros_like(objects),
        weights=np.ones(len(objects), np.float32),
        model=np.array("clip 1"),
        embeddings=vectors.astype(np.float16),
    )


def objects_of(run: Path) -> dict[int, dict]:
    """The objects of a run, which agree with the column of its map."""
    objects = json.loads((run / "objects.json").read_text())["objects"]
    ids = read_splats(run / "map.ply").extra["instance"]
    found = {one["id"]: one for one in objects}
    assert len(found) == len(objects) > 1
    numbers, counts = np.unique(ids[ids > 0], return_counts=True)
    assert {n: one["gaussians"] for n, one in found.items()} == dict(
        zip(numbers.tolist(), counts.tolist(), strict=True)
    )
    return found


def share_kept(before: Path, after: Path) -> float:
    """Share of the Gaussians near those of an earlier map that have the object of the nearest."""
    old, new = (read_splats(run / "map.ply") for run in (before, after))
    distance, nearest = cKDTree(old.means).query(new.means)
    near = distance < 1e-4
    assert near.sum() > 100
    return float((new.extra["instance"][near] == old.extra["instance"][nearest[near]]).mean())


@pytest.mark.parametrize("options", [[], GEOMETRIC], ids=["without masks", "with masks"])
def test_a_continued_map_keeps_its_objects(walks, tmp_path, capsys, options):
    a, _, recordings = walks
    saved, out = shutil.copytree(a, tmp_path / "saved"), tmp_path / "run"
    continued = ["--map", str(saved), "--scene.graph", *options]
    assert main(walk(recordings[1], out, *continued)) == 0
    graph = json.loads((out / "scene_graph.json").read_text())
    assert any(node["kind"] == "object" for node in graph["nodes"])
    before, after = objects_of(a), objects_of(out)
    assert share_kept(a, out) > 0.99
    for number in set(before) & set(after):
        assert after[number]["class"] == before[number]["class"]
        assert after[number]["first_keyframe"] < 0
    splats = read_splats(out / "map.ply")
    new = splats.extra["submap"] == 1
    assert (splats.extra["instance"][new] > 0).any() == bool(options)
    if options:
        # The second walk sees the objects of the first one again.
        assert any(after[n]["views"] > one["views"] for n, one in before.items() if n in after)
    vectors = read_objects(out / "objects.npz")
    assert vectors.model == "clip 1"
    capsys.readouterr()
    assert main(["query", str(out), "--summary", str(out / "scene.json")]) == 0
    listed = {one["id"]: one for one in json.loads((out / "scene.json").read_text())["objects"]}
    for number, instance in zip(vectors.ids, vectors.instances, strict=True):
        assert listed[number]["instance"] == instance


def test_a_merged_map_has_the_objects_of_both(walks, tmp_path):
    a, b, _ = walks
    out = tmp_path / "ab"
    assert main(["register", str(a), str(b), "--out", str(out), *FAST]) == 0
    first, second, both = objects_of(a), objects_of(b), objects_of(out)
    # The walks overlap: some objects are one, and no number of B is taken for one of A.
    assert len(both) < len(first) + len(second)
    assert len(set(both) - set(first)) <= len(second)
    assert share_kept(a, out) > 0.99
    joined = [one for n, one in both.items() if n in first and one["views"] > first[n]["views"]]
    assert joined


def test_a_map_without_objects_merges_with_one_that_has_some(walks, tmp_path):
    a, b, _ = walks
    bare, out = shutil.copytree(b, tmp_path / "bare"), tmp_path / "ab"
    (bare / "objects.json").unlink()
    assert main(["register", str(bare), str(a), "--out", str(out), *FAST]) == 0
    assert set(objects_of(out)) <= set(objects_of(a))


def test_a_refined_map_keeps_its_objects(walks, tmp_path):
    a, _, _ = walks
    out = tmp_path / "refined"
    assert main(["refine", str(a), "--out", str(out), "--iterations", "1"]) == 0
    before, after = objects_of(a), objects_of(out)
    assert set(after) <= set(before)
    assert len(after) > 0.8 * len(before)
    old, new = (read_splats(run / "map.ply") for run in (a, out))
    _, nearest = cKDTree(old.means).query(new.means)
    kept = new.extra["instance"] == old.extra["instance"][nearest]
    assert kept.mean() > 0.95
    assert read_objects(out / "objects.npz").model == "clip 1"


def test_embeddings_of_an_unnamed_model_can_be_continued(walks, tmp_path):
    run = RunFolder(shutil.copytree(walks[0], tmp_path / "a"))
    vectors = read_objects(run.embeddings)
    write_objects(run.embeddings, replace(vectors, model="masks"))
    saved = load_objects(run)
    assert saved is not None
    assert saved.model == ""
    assert all(one.embedding is not None for one in saved.objects)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "broken", "objects.json is damaged"),
        (lambda text: text.replace('"id": 1,', '"id": 2,', 1), "does not belong to"),
    ],
)
def test_damaged_objects_end_a_program_with_one_line(walks, tmp_path, capsys, change, message):
    _, b, _ = walks
    broken, out = shutil.copytree(b, tmp_path / "b"), tmp_path / "ab"
    file = broken / "objects.json"
    file.write_text(change(file.read_text()))
    assert message in error_of(capsys, "refine", broken, "--out", out)
    assert not out.exists() or not list(out.iterdir())
