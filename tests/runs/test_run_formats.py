"""Run folders of earlier versions: jobs read what they need, or name both versions.

`stored/` has a small finished run of each earlier format, written by the version of its time over
the frames of `tiny_recording`.
"""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import SettingsError
from toolkit.base.version import __version__
from toolkit.io.arrays import read_array_tree
from toolkit.io.splats import read_splats
from toolkit.runs.formats import RUN_FORMAT
from toolkit.runs.maps import saved_map
from toolkit.runs.maps.finished import load_run
from toolkit.runs.settings import RunSettings, dump_settings, load_stored_settings
from toolkit.slam.mapping.options import MapperOptions
from toolkit.tools.cli.main import main

STORED = Path(__file__).with_name("stored")
FOLDERS = sorted(path.stem for path in STORED.glob("*.zip"))
READERS = {
    "query": "query {run} --summary {out}.json",
    "splats": "export {run} --to {out}.ply",
    "scene graph": "export {run} --to {out}.json --format scene-graph",
    "viewer": "export {run} --to {out}.html --format viewer",
    "render": "render {run} --out {out} --what colour strip labels",
    "edit": "edit {run} --out {out} --remove wall",
    "compare": "compare {run} {tiny_run} --out {out}.html",
    "explain-loops": "explain-loops {run} --out {out}",
    "evaluate": "evaluate {run} --max-views 1",
}


@pytest.fixture(params=FOLDERS)
def stored_run(request, tiny_recording: Path, tmp_path: Path) -> Path:
    """A finished run of an earlier version, beside the recording."""
    (tmp_path / "recording").symlink_to(tiny_recording)
    with zipfile.ZipFile(STORED / f"{request.param}.zip") as file:
        file.extractall(tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("job", READERS)
def test_jobs_that_read_a_map_read_every_format(stored_run, tiny_run, tmp_path, caplog, job):
    words = READERS[job].format(run=stored_run, tiny_run=tiny_run, out=tmp_path / "out")
    assert main(words.split()) == 0
    notes = [r.getMessage() for r in caplog.records if "was written by" in r.getMessage()]
    assert len(notes) == (0 if job == "compare" else 1)
    for note in notes:
        assert str(stored_run) in note and "\n" not in note
        assert f"this is semsplat {__version__} (format {RUN_FORMAT})" in note


def test_the_map_is_read_as_it_was_written(stored_run):
    run = load_run(stored_run)
    assert len(run.gaussians) == len(read_splats(stored_run / "map.ply").means) > 200
    assert [frame.index for frame in run.tracked] == list(range(6))
    assert [(state.index, state.state) for state in run.states] == [
        (index, "tracked") for index in range(6)
    ]
    assert run.metric and [part.frames for part in run.parts] == [6]
    (submap,) = run.submaps.values()
    assert [keyframe.index for keyframe in submap.keyframes] == run.keyframes
    labels = read_splats(stored_run / "map.ply").extra["label"]
    decoded = run.semantics.decode_gaussians(run.gaussians.features).class_ids
    # The file has the labels of the features before they were rounded to half precision.
    assert np.mean(np.asarray(decoded) == labels) > 0.98


def test_jobs_that_need_all_settings_name_both_versions(stored_run, tmp_path, capsys):
    def error(*words: object) -> str:
        assert main([str(word) for word in words]) == 2
        return capsys.readouterr().err.strip().splitlines()[-1]

    versions = rf"run folder format \d\), this is semsplat {__version__} \(format {RUN_FORMAT}\)"
    line = error("refine", stored_run, "--out", tmp_path / "refined")
    assert re.search(versions, line) and f"run --map {stored_run}/map.ply" in line
    assert not (tmp_path / "refined").exists()
    line = error("run", "--config", stored_run / "config.yaml", "--out", stored_run, "--resume")
    assert "settings are those of another version" in line and "or start a new run" in line


def test_maps_whose_codes_are_not_known_are_not_extended(tiny_recording, tmp_path, capsys):
    with zipfile.ZipFile(STORED / "format_1.zip") as file:
        file.extractall(tmp_path / "run")
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    out = tmp_path / "out"
    assert main(["run", *words, "--map", str(tmp_path / "run"), "--out", str(out)]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "run folder format 1" in line and f"--map {tmp_path / 'run/map.ply'}" in line
    assert not out.exists()


def test_maps_of_spheres_are_not_extended_by_ellipsoids(tmp_path):
    with zipfile.ZipFile(STORED / "format_2_spheres.zip") as file:
        file.extractall(tmp_path / "run")
    saved = load_run(tmp_path / "run")
    with pytest.raises(SettingsError, match=r"spheres.*set --mapping\.final-shape spheres"):
        saved_map._check_shapes(saved, RunSettings())
    saved_map._check_shapes(saved, RunSettings(mapping=MapperOptions(final_shape="spheres")))


def test_only_what_this_version_lacks_is_ignored(tmp_path):
    file = tmp_path / "config.yaml"
    stored = dump_settings(RunSettings(seed=7))
    file.write_text(stored)
    assert load_stored_settings(file) == (RunSettings(seed=7), ())
    file.write_text(stored.replace("denoise: true", "denoise: 3"))
    with pytest.raises(SettingsError, match="denoise"):
        load_stored_settings(file)
    # Beside unknown settings, a value that is not accepted is one of another version.
    file.write_text(stored.replace("denoise: true", "denoise: 3\nspeed: {limit: 1}"))
    settings, ignored = load_stored_settings(file)
    assert settings == RunSettings(seed=7) and set(ignored) == {"denoise", "speed"}
    file.write_text(f"{stored}extra: 1\n".replace("submaps:\n", "submaps:\n  budget: 3\n"))
    settings, ignored = load_stored_settings(file)
    assert settings == RunSettings(seed=7) and set(ignored) == {"submaps.budget", "extra"}


def test_a_change_of_the_files_has_a_new_format(tiny_run):
    """The names in the files of a run are those listed for the format.

    If a name was removed, or changes what it stands for, increment `RUN_FORMAT`, read the earlier
    format in `toolkit/runs/formats.py`, and store a run of the earlier version in `stored/`.
    Otherwise add the name to the list.
    """
    frames = json.loads((tiny_run / "frames.json").read_text())
    assert frames["format"] == RUN_FORMAT and frames["version"] == __version__
    names = {f"frames.json {name}" for name in _names(frames)}
    for tree in (tiny_run / "semantics", *(tiny_run / "submaps").iterdir()):
        content = read_array_tree(tree)
        found = {*content.arrays, *_names(content.metadata)}
        part = tree.relative_to(tiny_run).parts[0]
        names |= {f"{part} {re.sub('[0-9]+/', 'N/', name)}" for name in found}
    names |= {f"map.ply {name}" for name in read_splats(tiny_run / "map.ply").extra}
    listed = (STORED / f"format_{RUN_FORMAT}.txt").read_text().splitlines()
    assert sorted(names) == listed


def _names(content: object) -> set[str]:
    """The dotted keys of nested dictionaries and lists."""
    if isinstance(content, list):
        return {name for item in content for name in _names(item)}
    if not isinstance(content, dict):
        return set()
    inner = {f"{key}.{name}" for key, value in content.items() for name in _names(value)}
    return {*content, *inner}
