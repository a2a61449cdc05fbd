"""register: two runs of one room become one map; what cannot be verified leaves nothing."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from programs import semsplat

from toolkit.base.geometry import se3
from toolkit.io.arrays import read_array_tree, write_array_tree
from toolkit.io.splats import read_splats
from toolkit.io.trajectories import read_tum
from toolkit.runs.maps.finished import load_run
from toolkit.runs.settings import load_settings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.loops import two_maps
from toolkit.slam.loops.verification import VerificationLimits, rejection_reason
from toolkit.tools.cli.main import main

FAST = ["--registration.views", "4"]


def error_of(capsys, *words: object) -> str:
    """The line that a program fails with, below its progress bars."""
    assert main([str(word) for word in words]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("semsplat: error: ")
    return line


@pytest.fixture(scope="module")
def merged(room_runs, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("merged") / "ab"
    done = semsplat("register", room_runs.a, room_runs.b, "--out", out, *FAST)
    assert done.returncode == 0, done.stderr
    for word in ("overlap", "inliers", "with the same class", "residuals"):
        assert word in done.stdout
    return out


@pytest.fixture
def b(room_runs, tmp_path) -> Path:
    """A copy of the second run, to be damaged."""
    return shutil.copytree(room_runs.b, tmp_path / "b")


def figures(folder: Path) -> dict:
    return json.loads((folder / "register.json").read_text())


def test_it_finds_where_the_other_map_lies(merged, room_runs):
    found = figures(merged)
    difference = se3.inverse(room_runs.T_a_b) @ np.array(found["T_a_b"])
    assert np.linalg.norm(difference[:3, 3]) < 0.03
    assert se3.rotation_angle_rad(difference[:3, :3]) < 0.02
    assert found["verified"] == found["agreeing"] == 1 and found["tried"][0]["accepted"]
    assert found["overlap"] > 0.5 and found["inliers"] > 0.8 and found["class_agreement"] > 0.8


def test_the_merged_map_contains_common_surfaces_once(merged, room_runs):
    splats = read_splats(merged / "map.ply")
    found = figures(merged)
    assert len(splats.means) == found["gaussians"]
    # Most of either walk is in the other: two whole maps in one would be far more.
    assert found["gaussians"] < 0.8 * (found["gaussians_a"] + found["gaussians_b"])
    submap = splats.extra["submap"]
    assert set(submap.tolist()) == {0, 1}
    # Of B is left what it alone has seen, and it lies where A's frame has it.
    T_a_b = np.array(found["T_a_b"])
    own = read_splats(room_runs.b / "map.ply").means
    there = own @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    taken = splats.means[submap == 1]
    assert np.abs(taken[:50, None] - there[None]).sum(axis=2).min(axis=1).max() < 1e-4


def test_labels_are_those_of_either_run(merged, room_runs):
    splats = read_splats(merged / "map.ply")
    assert Taxonomy.load(merged / "taxonomy.yaml") == Taxonomy.load(room_runs.a / "taxonomy.yaml")
    assert (splats.labels.label > 0).mean() > 0.95
    own = read_splats(room_runs.a / "map.ply")
    label_of = dict(zip(map(tuple, own.means.tolist()), own.labels.label, strict=True))
    kept = [
        (label, label_of[mean])
        for mean, label in zip(map(tuple, splats.means.tolist()), splats.labels.label, strict=True)
        if mean in label_of
    ]
    assert len(kept) > 500 and np.mean([one == other for one, other in kept]) > 0.99


def test_both_paths_are_in_the_first_frame(merged, room_runs):
    a, b = (read_tum(merged / f"trajectory_{name}.txt") for name in "ab")
    assert (merged / "trajectory_a.txt").read_bytes() == (
        room_runs.a / "trajectory.txt"
    ).read_bytes()
    T_a_b = np.array(figures(merged)["T_a_b"])
    assert np.allclose(b.T_world_camera[0], T_a_b, atol=1e-6)
    # Both walks share frames 5 to 8, seen in opposite order.
    assert np.allclose(a.T_world_camera[8], b.T_world_camera[5], atol=0.03)


def test_a_run_fits_itself(room_runs, tmp_path):
    assert (
        main(["register", str(room_runs.a), str(room_runs.a), "--out", str(tmp_path), *FAST]) == 0
    )
    assert np.allclose(np.array(figures(tmp_path)["T_a_b"]), np.eye(4), atol=2e-3)
    assert len(read_splats(tmp_path / "map.ply").means) < 1.2 * len(
        read_splats(room_runs.a / "map.ply").means
    )


def test_what_cannot_be_verified_leaves_nothing(room_runs, tmp_path, capsys, monkeypatch):
    words = [room_runs.a, room_runs.b, "--out", tmp_path / "m", *FAST]
    strict = partial(rejection_reason, limits=VerificationLimits(min_overlap=1.0))
    monkeypatch.setattr(two_maps, "rejection_reason", strict)
    line = error_of(capsys, "register", *words)
    assert "% overlap" in line and "can be verified" in line
    assert not (tmp_path / "m").exists()


def other_tree(run: Path) -> None:
    """Give a run a tree of the same classes in other groups, as if it had been made with it."""
    tree = Taxonomy.load(run / "taxonomy.yaml")
    Taxonomy({"all": list(tree.classes)}, classes=tree.classes).save(run / "taxonomy.yaml")
    kept = read_array_tree(run / "semantics")
    tree = Taxonomy.load(run / "taxonomy.yaml")
    code = build_code(load_settings(run / "config.yaml").semantics.code, tree)
    features = np.zeros((len(kept.arrays["features"]), code.channels), np.float16)
    digest = {"taxonomy": tree.digest}
    write_array_tree(
        run / "semantics", kept.arrays | {"features": features}, kept.metadata | digest
    )


def test_different_trees_merge_without_labels(room_runs, b, tmp_path, capsys):
    other_tree(b)
    assert main(["register", str(room_runs.a), str(b), "--out", str(tmp_path / "m"), *FAST]) == 0
    said = capsys.readouterr().out
    assert "has no labels" in said and str(b / "taxonomy.yaml") in said
    assert read_splats(tmp_path / "m/map.ply").labels is None
    assert figures(tmp_path / "m")["class_agreement"] is None
    assert not (tmp_path / "m/taxonomy.yaml").exists()


def test_the_final_anchors_count(b):
    """Corrections move anchors without touching a submap's own file."""
    frames = json.loads((b / "frames.json").read_text())
    T = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.1, 0.0]))
    frames["submaps"][0]["T_world_submap"] = T.tolist()
    (b / "frames.json").write_text(json.dumps(frames))
    submaps = load_run(b).submaps
    assert list(submaps) == [0] and np.allclose(submaps[0].T_world_submap, T)
    assert len(submaps[0].descriptors) == len(submaps[0].keyframes) > 0


def without_submaps(run: Path) -> None:
    shutil.rmtree(run / "submaps")


def without_list_of_submaps(run: Path) -> None:
    frames = json.loads((run / "frames.json").read_text())
    del frames["submaps"]
    (run / "frames.json").write_text(json.dumps(frames))


def without_descriptors(run: Path) -> None:
    (folder,) = (run / "submaps").iterdir()
    kept = read_array_tree(folder)
    bare = {"descriptors": np.zeros((0, 0), np.float32)}
    write_array_tree(folder, kept.arrays | bare, kept.metadata)


def without_loops(run: Path) -> None:
    without_descriptors(run)
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("loops:\n  use: true", "loops:\n  use: false"))


def with_other_descriptors(run: Path) -> None:
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("kind: vlad", "kind: dinov2"))


def with_a_damaged_submap(run: Path) -> None:
    (folder,) = (run / "submaps").iterdir()
    (folder / "arrays.npz").write_bytes(b"no zip")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (without_submaps, "run again"),
        (without_list_of_submaps, "run again"),
        (without_descriptors, "--depth none or --poses given"),
        (without_loops, "--loops.use"),
        (with_other_descriptors, "loops.features.kind dinov2"),
        (with_a_damaged_submap, "damaged"),
    ],
)
def test_runs_that_cannot_be_registered(room_runs, b, tmp_path, capsys, damage, said):
    damage(b)
    line = error_of(capsys, "register", room_runs.a, b, "--out", tmp_path / "m")
    assert said in line and str(b) in line
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["register", "A", "A/renders", "--out", "OUT"], "no run"),
        (["register", "A/nothing", "A", "--out", "OUT"], "no run"),
        (["register", "A", "A", "--out", "A"], "choose another --out"),
        (["register", "A", "A", "--out", "OUT", "--pairs", "0"], "--pairs"),
        (["register", "A", "--out", "OUT"], "Folder of the run that is moved"),
    ],
)
def test_bad_input(room_runs, tmp_path, capsys, words, said):
    places = {"A": room_runs.a, "OUT": tmp_path / "m"}
    words = [word.replace("OUT", str(places["OUT"])) for word in words]
    words = [str(places["A"]) + word[1:] if word[0] == "A" else word for word in words]
    assert said in error_of(capsys, *words)
    assert not (tmp_path / "m").exists()
