"""Runs over two places: files, summary, report, viewer, evaluation and refinement by part."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from parts_recording import FIRST, SECOND, THIRD, write_two_places

from toolkit.io.splats import read_splats
from toolkit.io.trajectories import read_tum
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.maps.finished import load_run
from toolkit.slam.loops.relocalisation import Relocaliser
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.result import Health
from toolkit.tools.cli.main import main
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.reading import read_scene

DOUBTFUL, LOST = 3, [6, 7]
QUICK = [
    *("--mapping.first-iterations", "8"),
    *("--mapping.iterations", "3"),
    *("--mapping.final-iterations", "1"),
    *("--mapping.keyframes.interval", "1"),
    *("--loops.candidates.min-gap-frames", "100"),
    *("--loops.relocalisation.patience", "2"),
]


def run_words(recording: Path, out: Path, *more: str) -> list[str]:
    place = ["--dataset.kind", "synthetic", "--dataset.path", str(recording)]
    return ["run", *place, *QUICK, "--out", str(out), *more]


@pytest.fixture(scope="module")
def divided(tmp_path_factory) -> tuple[Path, str]:
    """A run whose second place is a part of its own, with a doubtful frame, and its messages."""
    folder = tmp_path_factory.mktemp("divided")
    write_two_places(folder / "recording")
    track = DenseTracker.track

    def doubting(self, frame, gaussians, proposals=None):
        result = track(self, frame, gaussians, proposals)
        if frame.index == DOUBTFUL:
            return replace(result, health=Health.DOUBTFUL, reason="the view is ambiguous by 12 %")
        return result

    find = Relocaliser.find

    def not_found(self, frame, *arguments, **options):
        return None if frame.index == DOUBTFUL else find(self, frame, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DenseTracker, "track", doubting)
        patch.setattr(Relocaliser, "find", not_found)
        assert main(run_words(folder / "recording", folder / "run")) == 0
    return folder / "run", (folder / "run/log.txt").read_text(encoding="utf-8")


def content(run: Path, name: str):
    return json.loads((run / name).read_text(encoding="utf-8"))


def test_the_run_folder_contains_the_main_part(divided):
    run, _ = divided
    frames = content(run, "frames.json")
    own = [index for index in (*FIRST, *THIRD) if index != DOUBTFUL]
    assert [row["index"] for row in frames["frames"]] == own
    assert len(read_tum(run / "trajectory.txt")) == len(own)
    assert set(read_splats(run / "map.ply").extra["submap"].tolist()) == {0, 2}
    assert frames["lost"] == LOST
    assert [(row["number"], row["part"]) for row in frames["submaps"]] == [(0, 0), (1, 1), (2, 0)]


def test_the_other_part_is_exported_in_its_own_frame(divided):
    run, _ = divided
    trajectory = read_tum(run / "parts/1/trajectory.txt")
    assert len(trajectory) == len(SECOND) - len(LOST)
    assert np.allclose(trajectory.T_world_camera[0], np.eye(4), atol=1e-6)
    splats = read_splats(run / "parts/1/map.ply")
    assert set(splats.extra["submap"].tolist()) == {1} and splats.labels is not None
    assert (run / "parts/1/covariances.txt").is_file()
    assert read_scene(run / "parts/1/map.ply", ShownContent()).tree is not None
    assert not (run / "parts/0").exists()


def test_every_frame_has_its_state(divided):
    run, _ = divided
    states = content(run, "frames.json")["states"]
    assert [row["index"] for row in states] == list(range(THIRD.stop))
    for row in states:
        index = row["index"]
        expected = "lost" if index in LOST else "doubtful" if index == DOUBTFUL else "tracked"
        assert row["state"] == expected
        assert bool(row.get("reason")) == (expected != "tracked")
        part = int(index in SECOND) if expected == "tracked" else None
        assert row.get("part") == part
    assert all(row["steps"] > 0 for row in states if row.get("keyframe") and row["index"] < 6)
    keyframes = [row["index"] for row in states if row.get("keyframe")]
    assert keyframes == content(run, "frames.json")["keyframes"]


def test_parts_have_the_reason_of_their_loss(divided):
    run, _ = divided
    main_part, other = content(run, "frames.json")["parts"]
    assert main_part["loss"] is None and main_part["frames"] == len(FIRST) + len(THIRD) - 1
    assert (other["submaps"], other["frames"]) == ([1], 4)
    assert (other["first"], other["last"]) == (8, 11)
    assert other["loss"]["index"] == LOST[0] and other["loss"]["reason"]


def test_metrics_count_states_and_parts(divided):
    run, _ = divided
    metrics = content(run, "metrics.json")
    frames, part = metrics["frames"], metrics["parts"]["part_1"]
    assert (frames["total"], frames["lost"], frames["doubtful"]) == (17, 2, 1)
    assert (metrics["parts"]["count"], frames["in_other_parts"]) == (2, 4)
    assert metrics["trajectory"]["ate_pairs"] == len(FIRST) + len(THIRD) - 1
    # Against the truth, only the main part is evaluated together.
    assert metrics["trajectory"]["ate_rmse_cm"] < 0.3
    assert part["frames"] == 4 and part["ate_rmse_cm"] > 0.0


def test_the_summary_names_ranges_and_reasons(divided):
    run, log = divided
    reason = content(run, "frames.json")["states"][6]["reason"]
    assert f"2 of 17 frames are lost: 6-7 ({reason})." in log
    assert "1 of 17 frames are doubtful, their poses may be wrong: 3 (the view is ambiguous" in log
    assert (
        "Frames 8-11 (4 frames) form a separate part, parts/1; its position relative to the main "
        f"part is unknown: the camera was lost at frame 6 ({reason})."
    ) in log
    assert f"Frame {DOUBTFUL} is doubtful: the view is ambiguous by 12 %." in log


def test_the_report_shows_states_and_reasons(divided):
    run, _ = divided
    page = (run / "report.html").read_text(encoding="utf-8")
    strip = page[page.index('<div class="states"') :]
    strip = strip[: strip.index("</div>")]
    for css, title in (
        ("doubtful", "frames 3, doubtful: the view is ambiguous by 12 %"),
        ("lost", "frames 6-7, lost: "),
        ("other", "frames 8-11, tracked, part 1"),
        ("tracked", "frames 12-16, tracked"),
    ):
        assert f'<i class="{css}"' in strip and title in strip
    assert "<td>6-7</td><td>lost</td>" in page and "<td>3</td><td>doubtful</td>" in page
    assert "form a separate part" in page and "and 1 doubtful" in page


def test_a_finished_run_is_its_main_part(divided):
    run = load_run(divided[0])
    assert sorted(run.submaps) == [0, 2]
    assert len(run.trajectory) == len(run.tracked) == len(FIRST) + len(THIRD) - 1
    assert [part.number for part in run.parts] == [0, 1]
    assert list(run.separate_trajectories()) == [1]
    truth = run.open_dataset().ground_truth
    assert absolute_trajectory_error(run.trajectory, truth).rmse_m < 0.003


def test_the_viewer_marks_doubtful_and_interrupted_ways(divided):
    scene = read_scene(divided[0], ShownContent())
    # Neither the doubtful frame nor the lost ones have a pose.
    assert scene.path_states.tolist() == [0, 0, 0, 2, 0, 2, 0, 0, 0, 0]
    assert len({tuple(rgb) for rgb in scene.path_colours}) >= 1
    assert any("separate part" in note for note in scene.notes)
    assert {k.submap for k in scene.keyframes} == {0, 2}


def test_evaluate_lists_the_parts(divided, capsys, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(divided[0], run)
    before = content(run, "metrics.json")
    assert main(["evaluate", str(run)]) == 0
    out = capsys.readouterr().out
    assert "Frames 8-11 (4 frames) form a separate part" in out
    assert any(line.split()[:1] == ["parts.part_1.ate_rmse_cm"] for line in out.splitlines())
    after = content(run, "metrics.json")
    assert after["frames"] == before["frames"]
    assert after["parts"]["count"] == before["parts"]["count"]
    ate_rmse_cm = before["parts"]["part_1"]["ate_rmse_cm"]
    assert after["parts"]["part_1"]["ate_rmse_cm"] == pytest.approx(ate_rmse_cm, abs=1e-2)


def test_refinement_keeps_the_parts(divided, tmp_path):
    run, _ = divided
    assert main(["refine", str(run), "--out", str(tmp_path / "refined")]) == 0
    refined = load_run(tmp_path / "refined")
    assert sorted(refined.submaps) == [0, 2]
    for name in ("trajectory.txt", "map.ply"):
        copied = (tmp_path / "refined/parts/1" / name).read_bytes()
        assert copied == (run / "parts/1" / name).read_bytes()


def test_a_run_extends_the_main_part_only(divided, tmp_path, caplog):
    run, _ = divided
    write_two_places(tmp_path / "recording", returns=False)
    with caplog.at_level(logging.INFO):
        words = run_words(tmp_path / "recording", tmp_path / "run", "--map", str(run))
        assert main([*words, "--max-frames", "4"]) == 0
    assert "Relocalising in 2 submap(s)" in caplog.text
    metrics = content(tmp_path / "run", "metrics.json")
    assert (metrics["parts"]["count"], metrics["frames"]["lost"]) == (1, 0)
