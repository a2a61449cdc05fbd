"""Runs with semantics: what they leave, how they are read again, what they say to bad input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_finished_run_programs import one_line_of_error

from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.io.splats import read_splats
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.slam.mapping import semantic_mapping
from toolkit.tools.cli.main import main

QUICK = [
    *("--mapping.first-iterations", "6"),
    *("--mapping.iterations", "3"),
    *("--mapping.final-iterations", "2"),
]


@pytest.fixture(scope="session")
def labelled_recording(tmp_path_factory) -> Path:
    """Eight frames of a small room in Replica's layout, with labels."""
    folder = tmp_path_factory.mktemp("labelled") / "room"
    frames, truth = tiny_room(8, 80, 60)
    prepare_folder(folder)
    write_sequence(folder, frames, frames[0].camera, truth.T_world_camera)
    return folder


def arguments(recording: Path, out: Path, *more: str, pace: list[str] = QUICK) -> list[str]:
    place = ["--dataset.kind", "synthetic", "--dataset.path", str(recording)]
    given = ["--poses", "given", "--hold-out", "4"]
    return ["run", *place, *given, *pace, "--out", str(out), *more]


def error_of(capsys, *words: object) -> str:
    """The line that a program fails with, below its progress bars."""
    assert main([str(word) for word in words]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("semsplat: error: ")
    return line


@pytest.fixture(scope="session")
def run(labelled_recording, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(arguments(labelled_recording, out)) == 0
    return out


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def test_a_run_knows_what_it_mapped(run):
    metrics = metrics_of(run)
    labels = metrics["semantics"]
    assert labels["mapped"]["miou_percent"] > 70.0  # many classes have a few pixels here
    assert labels["unseen"]["miou_percent"] > 50.0
    assert labels["mapped"]["accuracy_percent"] > 97.0
    assert labels["mapped"]["level_0"]["miou_percent"] >= labels["mapped"]["miou_percent"]
    assert labels["levels"]["level_0"] == "size"
    assert 0.0 <= labels["mapped"]["ece_percent"] < 10.0


def test_a_run_leaves_its_tree_and_labelled_splats(run):
    taxonomy = Taxonomy.load(run / "taxonomy.yaml")
    assert taxonomy == shipped_taxonomy("replica")
    labels = read_splats(run / "map.ply").labels
    assert labels.levels.shape[1] == taxonomy.depth
    labelled = labels.label > 0
    assert labelled.mean() > 0.99
    # Where a level is sure, it lies on the label's own path.
    sure = labelled & (labels.confidence > 0.6)
    path = taxonomy.node_ids[labels.label[sure] - 1]
    levels = labels.levels[sure]
    assert (levels == path)[levels >= 0].all()
    assert list((run / "renders").glob("*_levels.png"))


def test_measuring_again_gives_the_same_labels(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "copy")
    before = metrics_of(copy)
    assert main(["evaluate", str(copy)]) == 0
    after = metrics_of(copy)
    for views, key in (
        ("mapped", "miou_percent"),
        ("unseen", "miou_percent"),
        ("mapped", "accuracy_percent"),
        ("mapped", "ece_percent"),
    ):
        expected = pytest.approx(before["semantics"][views][key], abs=0.02)
        assert after["semantics"][views][key] == expected


def test_evaluate_computes_lpips_and_the_subset_miou_on_request(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "copy")
    before = metrics_of(copy)
    assert before["images"]["mapped"]["lpips"] is None
    assert before["semantics"]["mapped"]["miou_subset_percent"] is None
    weights = tmp_path / "lpips.pth"
    torch.save(random_lpips_weights(), weights)
    words = ["evaluate", str(copy), "--subset", "--lpips-weights", str(weights)]
    assert main([*words, "--max-views", "3"]) == 0
    after = metrics_of(copy)
    assert after["images"]["mapped"]["lpips"] > 0.0
    assert after["images"]["unseen"]["lpips"] > 0.0
    labels = after["semantics"]["mapped"]
    assert labels["miou_subset_percent"] > 70.0
    assert labels["miou_subset_percent"] != labels["miou_visible_percent"]
    printed = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    values = flattened(after)
    for key in ("images.mapped.lpips", "semantics.mapped.miou_subset_percent"):
        assert printed[key] == f"{values[key]:.3f}"
    # Measured again without them they are null, and not those of the other views.
    assert main(["evaluate", str(copy)]) == 0
    again = metrics_of(copy)
    assert again["images"]["mapped"]["lpips"] is None
    assert again["semantics"]["mapped"]["miou_subset_percent"] is None


def test_run_computes_lpips_and_refuses_bad_weights_at_once(labelled_recording, tmp_path, capsys):
    weights = tmp_path / "lpips.pth"
    torch.save(random_lpips_weights(), weights)
    words = ["--evaluation.lpips-weights", str(weights), "--evaluation.subset"]
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, *words, "--max-frames", "2")) == 0
    first = metrics_of(out)
    assert first["images"]["mapped"]["lpips"] > 0.0
    assert first["semantics"]["mapped"]["miou_subset_percent"] > 0.0
    # Evaluated again with the same weights by default, or without them where they are gone.
    assert main(["evaluate", str(out)]) == 0
    expected = pytest.approx(first["images"]["mapped"]["lpips"], rel=0.01)
    assert metrics_of(out)["images"]["mapped"]["lpips"] == expected
    weights.unlink()
    assert main(["evaluate", str(out)]) == 0
    assert metrics_of(out)["images"]["mapped"]["lpips"] is None
    capsys.readouterr()
    line = one_line_of_error(capsys, *arguments(labelled_recording, tmp_path / "other", *words))
    assert str(weights) in line
    assert not (tmp_path / "other").exists()


def random_lpips_weights() -> dict[str, torch.Tensor]:
    """Every parameter of LPIPS, as one file may hold them."""
    generator = torch.Generator().manual_seed(0)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3)}
    shapes |= {8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    weights = {}
    for level, (index, shape) in enumerate(shapes.items()):
        weights[f"features.{index}.weight"] = torch.randn(shape, generator=generator) * 0.02
        weights[f"features.{index}.bias"] = torch.zeros(shape[0])
        weights[f"lin{level}.model.1.weight"] = torch.rand(1, shape[0], 1, 1, generator=generator)
    return weights


def test_labels_are_rendered_at_every_level(run, tmp_path):
    out = tmp_path / "views"
    words = ["render", str(run), "--what", "labels", "levels", "--every", "4", "--out", str(out)]
    assert main(words) == 0
    names = {file.name.rsplit("_", 1)[0] for file in out.iterdir()}
    assert names == {"levels", *(f"labels_l{i}" for i in range(5))}


def test_the_network_can_read_the_map(labelled_recording, tmp_path, monkeypatch):
    monkeypatch.setattr(semantic_mapping, "_LEARNING_RATE", 0.03)
    network = ["--semantics.network.use", "--semantics.reader", "network"]
    fast = ["--semantics.loss.inter-from", "1"]
    pace = ["--mapping.first-iterations", "50", "--mapping.final-iterations", "8"]
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, *network, *fast, pace=pace)) == 0
    accuracy_percent = metrics_of(out)["semantics"]["mapped"]["accuracy_percent"]
    assert accuracy_percent > 80.0
    assert main(["evaluate", str(out)]) == 0
    again = metrics_of(out)["semantics"]["mapped"]["accuracy_percent"]
    assert again == pytest.approx(accuracy_percent, abs=0.1)


# Blended colours of two classes are those of others.
@pytest.mark.parametrize(("code", "least"), [("flat", 97.0), ("binary", 97.0), ("colour", 88.0)])
def test_every_code_works(labelled_recording, tmp_path, code, least):
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, "--semantics.code.kind", code)) == 0
    assert metrics_of(out)["semantics"]["mapped"]["accuracy_percent"] > least


def test_without_semantics_nothing_of_them_is_left(labelled_recording, tmp_path):
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, "--semantics.code.kind", "none")) == 0
    assert not (out / "taxonomy.yaml").exists() and not (out / "semantics").exists()
    assert "semantics" not in metrics_of(out)
    assert read_splats(out / "map.ply").labels is None


@pytest.mark.parametrize("kind", ["geometric", "indoor"])
def test_without_labels_depth_gives_names(labelled_recording, tmp_path, kind):
    bare = shutil.copytree(labelled_recording, tmp_path / "bare")
    shutil.rmtree(bare / "labels")
    out = tmp_path / "run"
    words = [] if kind == "indoor" else ["--segmenter.kind", kind]
    assert main(arguments(bare, out, *words)) == 0
    assert Taxonomy.load(out / "taxonomy.yaml") == shipped_taxonomy(kind)
    names = Taxonomy.load(out / "taxonomy.yaml").classes
    found = {names[i - 1] for i in np.unique(read_splats(out / "map.ply").labels.label) if i}
    assert {"floor", "wall"} <= found


@pytest.mark.parametrize("word", ["floor", "flooring"])
def test_ignored_classes_are_not_mapped(run, labelled_recording, tmp_path, word):
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, "--semantics.ignore", word)) == 0
    floor = shipped_taxonomy("replica").find("floor").class_ids[0]
    before, after = (read_splats(r / "map.ply").labels.label for r in (run, out))
    assert (before == floor).sum() > 100
    assert (after == floor).sum() == 0
    assert len(after) < len(before)
    # Nor are they compared with the map.
    whole, rest = (read_metrics(r / "metrics.json") for r in (run, out))
    psnr_db, without_floor_db = (m["images"]["mapped"]["psnr_db"] for m in (whole, rest))
    assert without_floor_db > psnr_db - 1.0
    scores, others = whole["semantics"]["mapped"], rest["semantics"]["mapped"]
    assert others["classes"] == scores["classes"] - 1
    assert others["miou_with_void_percent"] > scores["miou_with_void_percent"] - 2.0


def test_a_map_without_semantics_has_no_labels_to_render(labelled_recording, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(arguments(labelled_recording, out, "--semantics.code.kind", "none")) == 0
    line = error_of(capsys, "render", out, "--what", "labels")
    assert "without semantics" in line


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--semantics.taxonomy", "nowhere.yaml"], "nowhere.yaml"),
        (["--semantics.taxonomy", "cityscapes"], "no taxonomy 'cityscapes' is shipped"),
        (["--semantics.taxonomy", "nyu40"], "has no class"),
        (["--semantics.ignore", "perzon"], "no class or group 'perzon'"),
        (["--semantics.ignore", "people"], "its classes are "),
        (["--segmenter.kind", "images"], "images.folder"),
        (["--segmenter.kind", "model"], "model.folder"),
    ],
)
def test_bad_settings_end_in_one_line(labelled_recording, tmp_path, capsys, more, expected):
    words = arguments(labelled_recording, tmp_path / "run", *more)
    assert expected in one_line_of_error(capsys, *words)


def test_a_label_without_a_name_is_refused(labelled_recording, tmp_path, capsys):
    broken = shutil.copytree(labelled_recording, tmp_path / "broken")
    file = sorted((broken / "labels").glob("label*.png"))[0]
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[5, 5] = 240
    cv2.imwrite(str(file), image)
    line = error_of(capsys, *arguments(broken, tmp_path / "run"))
    assert "240" in line and "frame 0" in line


def test_another_tree_does_not_read_a_map(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "report.html").unlink()  # as if it had been killed before
    taxonomy = Taxonomy.load(copy / "taxonomy.yaml")
    Taxonomy.flat(taxonomy.classes).save(copy / "taxonomy.yaml")
    assert "is not the taxonomy" in one_line_of_error(capsys, "evaluate", copy)
    (copy / "taxonomy.yaml").unlink()
    assert "missing" in one_line_of_error(capsys, "query", copy, "chair")


def test_a_run_resumed_with_another_tree_is_refused(run, labelled_recording, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "report.html").unlink()  # as if it had been killed before
    taxonomy = Taxonomy.load(copy / "taxonomy.yaml")
    Taxonomy.flat(taxonomy.classes).save(copy / "taxonomy.yaml")
    words = ["run", "--config", str(copy / "config.yaml"), "--out", str(copy), "--resume"]
    assert "another one" in one_line_of_error(capsys, *words)
