"""Every row of the benchmarks asks for settings that exist: renamed options must not break them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tyro
import yaml

from benchmarks.accuracy import sequences
from benchmarks.loops import detection, ring
from benchmarks.papers import definitions, plans, runs
from benchmarks.semantics import codes
from benchmarks.shared import recordings
from benchmarks.speed import live
from toolkit.base.options import validated
from toolkit.runs.batch.plan import load_plan
from toolkit.runs.settings import RunSettings
from toolkit.tools.cli import live as live_program
from toolkit.tools.cli import run as run_program

SETTINGS: dict[str, dict[str, Any]] = {
    **{f"ring: {name}": row["settings"] for name, row in ring.ROWS.items()},
    **{f"loops: {name}": {"loops": values} for name, values in detection.ROWS.items()},
}
COMMANDS = [
    *sequences.ROWS.values(),
    *(row for rows in codes.ROWS.values() for row in rows.values()),
]


def labelled(folder: Path) -> Path:
    """A room of one label image, of a bottle and a sofa."""
    (folder / "labels").mkdir(parents=True, exist_ok=True)
    names = {"classes": {"1": "bottle", "2": "sofa"}}
    (folder / "labels" / "classes.json").write_text(json.dumps(names))
    cv2.imwrite(str(folder / "labels" / "label000000.png"), np.array([[0, 1, 2]], np.uint8))
    return folder


def test_a_room_can_have_the_classes_of_the_indoor_segmenter(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recordings, "room", lambda name, seed: labelled(tmp_path / name))
    planned = runs.Place("room", (160, 120), indoor=True).planned(quick=False)
    labels = Path(planned["dataset"]["path"]) / "labels"
    found = cv2.imread(str(labels / "label000000.png"), cv2.IMREAD_UNCHANGED)
    names = {"0": "void"} | json.loads((labels / "classes.json").read_text())["classes"]
    assert [names[str(value)] for value in found[0]] == ["void", "thing", "sofa"]


@pytest.mark.parametrize("name", plans.GROUPS)
def test_plans_of_the_papers_tables_are_valid(name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("SEMSPLAT_DATA", str(tmp_path))
    for recording in recordings.RECORDINGS.values():
        (tmp_path / recording.folder).mkdir(parents=True, exist_ok=True)
    monkeypatch.setattr(
        recordings, "room", lambda name, seed: labelled(tmp_path / f"{name}-{seed}")
    )
    group = plans.GROUPS[name]
    for quick in (False, True):
        path = tmp_path / "plan.yaml"
        path.write_text(yaml.safe_dump(group.plan(runs.Effort(quick, 1 if quick else 5))))
        planned = load_plan(path).runs
        places, seeds = (1, 1) if quick else (len(group.sequences), group.seeds)
        assert len(planned) == places * seeds * len(group.settings)


def test_rows_of_the_papers_tables_have_runs_and_columns() -> None:
    for table in definitions.TABLES:
        assert set(table.columns) <= set(definitions.COLUMNS)
        for row in table.rows.values():
            group = plans.GROUPS[row.group]
            assert row.settings in group.settings
            assert any(name.startswith(row.sequence or "") for name in group.sequences)


def commands_with_every_option() -> list[list[str]]:
    """Few command lines that hold every option of the rows, since parsing one takes a while."""
    options = {tuple(words.split()) for row in COMMANDS for words in " ".join(row).split(" --")[1:]}
    commands: list[dict[str, list[str]]] = []
    for flag, *values in sorted(options):
        fitting = next((command for command in commands if flag not in command), None)
        if fitting is None:
            fitting = {}
            commands.append(fitting)
        fitting[flag] = values
    return [[w for f, v in command.items() for w in (f"--{f}", *v)] for command in commands]


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_of_a_row_are_valid(name: str) -> None:
    assert isinstance(validated(RunSettings, SETTINGS[name]), RunSettings)


@pytest.mark.parametrize("options", commands_with_every_option(), ids=lambda words: words[0])
def test_options_of_rows_are_those_of_run(options: list[str]) -> None:
    words = ["--dataset.path", "data", *options, "--out", "out"]
    assert run_program.parse_run(run_program.RunProgram, words, "run").out.name == "out"


@pytest.mark.parametrize("row", [row for row in live.ROWS.values() if row[1] == "live"])
def test_options_of_live_rows_are_those_of_live(row: list[str]) -> None:
    sequence, _, *options = row
    options = [word for word in options if word != live.VIEWER]
    options += ["run.rrd"] if options[-1] == "--record" else []
    words = ["--dataset.path", "data", *options, "--out", "out"]
    assert sequence in {*recordings.RECORDINGS, *recordings.ROOMS}
    program = run_program.parse_run(live_program.LiveProgram, words, "live")
    assert (program.camera, program.fps) == ("replay", live.FPS)


def test_sequences_of_rows_are_known() -> None:
    known = {*recordings.RECORDINGS, *recordings.ROOMS}
    assert {row[0] for row in COMMANDS} <= known


@pytest.mark.parametrize("name", recordings.ROOMS)
def test_options_of_rooms_are_those_of_make_room(name: str) -> None:
    from toolkit.tools.cli.programs import MakeRoomOptions

    options = tyro.cli(MakeRoomOptions, args=["--out", "room", *recordings.ROOMS[name]])
    assert options.out.name == "room"
