"""Plans of many runs: what they contain, and one line for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.base.errors import SettingsError
from toolkit.runs.batch.plan import PlannedRuns, load_plan
from toolkit.runs.batch.state import checkpoint_frame, planned_config, run_state
from toolkit.runs.settings import load_settings

PLAN = """
sequences:
  kitchen: {dataset: {kind: folder, path: data/kitchen}, options: {max_frames: 7}}
  office: {dataset: {kind: tum, path: /data/office}}
settings:
  default:
  coarse: {preset: fast, config: coarse.yaml, options: {mapping: {iterations: 4}}}
seeds: [3, 5]
out: results
"""


def planned(folder: Path, text: str = PLAN) -> PlannedRuns:
    (folder / "plan.yaml").write_text(text)
    (folder / "coarse.yaml").write_text("mapping: {iterations: 2, first_iterations: 6}\n")
    return load_plan(folder / "plan.yaml")


def test_a_plan_is_the_product_of_sequences_settings_and_seeds(tmp_path, monkeypatch):
    monkeypatch.chdir("/")  # paths are relative to the plan
    plan = planned(tmp_path)
    assert [run.name for run in plan.runs] == [
        f"{sequence}/{settings}/seed{seed}"
        for sequence in ("kitchen", "office")
        for settings in ("default", "coarse")
        for seed in (3, 5)
    ]
    first, coarse = plan.runs[0], plan.runs[2]
    assert first.folder == tmp_path / "results/kitchen/default/seed3"
    assert first.settings.dataset.path == tmp_path / "data/kitchen"
    assert (first.settings.seed, first.settings.max_frames) == (3, 7)
    assert plan.runs[4].settings.max_frames is None
    # Options precede the file, and the file the preset.
    assert (coarse.settings.mapping.iterations, coarse.settings.mapping.first_iterations) == (4, 6)
    fast = load_settings(preset="fast")
    assert coarse.settings.mapping.final_iterations == fast.mapping.final_iterations


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds", "sedes", "unknown key 'sedes'; did you mean key 'seeds'?"),
        ("options: {max_frames", "options: {max_frame", "options.max_frame'; did you mean"),
        ("preset: fast", "preset: fastest", "settings.coarse.preset"),
        ("path: data/kitchen", "paht: data/kitchen", "sequences.kitchen.dataset.paht"),
        (", path: /data/office", "", "'sequences.office.dataset.path' is missing"),
        ("iterations: 4", "iterations: -4", "settings.coarse.options.mapping.iterations"),
        ("max_frames: 7", "seed: 7", "belongs into 'seeds'"),
        ("[3, 5]", "[3, 3]", "different numbers"),
        ("kitchen:", "../kitchen:", "becomes a folder"),
        ("seeds:", "seeds: [", "is not YAML"),
    ],
)
def test_mistakes_in_a_plan_name_the_file_and_the_key(tmp_path, old, new, message):
    assert old in PLAN
    with pytest.raises(SettingsError) as caught:
        planned(tmp_path, PLAN.replace(old, new, 1))
    text = str(caught.value)
    assert message in text and "plan.yaml" in text and "\n" not in text


def test_the_state_of_a_run_follows_from_its_folder(tmp_path):
    run = planned(tmp_path).runs[0]
    assert run_state(run).state == "new"
    checkpoints = run.folder / "checkpoint"
    checkpoints.mkdir(parents=True)
    assert run_state(run).state == "new"  # killed before it wrote its settings
    (run.folder / "config.yaml").write_text(planned_config(run))
    assert run_state(run).text == "unfinished"
    for slot, frame in (("0", 12), ("1", 30)):
        (checkpoints / slot).mkdir()
        (checkpoints / slot / "metadata.json").write_text(f'{{"next_frame": {frame}}}')
    assert checkpoint_frame(run.folder) == 30
    assert run_state(run).text == "unfinished, frame 30"
    (run.folder / "metrics.json").write_text("{}")
    assert run_state(run).state == "unfinished"
    (run.folder / "report.html").write_text("")
    assert run_state(run).state == "finished"
    (run.folder / "config.yaml").write_text(planned_config(run).replace("seed: 3", "seed: 4"))
    assert "other settings" in run_state(run).text
    (run.folder / "config.yaml").unlink()
    assert run_state(run).state == "conflict"
