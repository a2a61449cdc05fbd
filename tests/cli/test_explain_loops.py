"""`semsplat explain-loops`: every suspicion has its picture, every verdict its line."""

from __future__ import annotations

import json

import cv2
import pytest

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.runs.evaluation.loop_gallery import results_of
from toolkit.tools.cli.explain_loops import main, summary
from toolkit.tools.cli.programs import ExplainLoopsOptions

CANDIDATE = {
    "kind": "candidate",
    "query": 8,
    "match": 1,
    "query_submap": 1,
    "match_submap": 0,
    "distance": 0.11,
    "cosine": 0.994,
    "landmark_distance": None,
    "accepted": True,
    "reason": "rank 1 of 1 by landmarks, 1 in its submap",
}
REFUSED = CANDIDATE | {
    "match": 2,
    "accepted": False,
    "reason": "descriptor distance 0.5, not below 0.2",
}
BETWEEN = {
    "kind": "between",
    "first": 0,
    "second": 1,
    "overlap": 0.5,
    "inliers": 0.97,
    "moved_m": 0.064,
    "turned_rad": 0.01,
    "accepted": True,
    "reason": "",
}
CORRECTION = {"kind": "correction between", "loops": 1, "largest_m": 0.05, "largest_rad": 0.01}
VERIFIED = {
    "kind": "verified",
    "first": 0,
    "second": 1,
    "query": 8,
    "match": 1,
    "shared": 0.8,
    "apart_m": 0.12,
    "accepted": True,
    "reason": "",
}
WITHIN = {"kind": "within", "query": 8, "match": 1, "accepted": False, "reason": "no match"}


@pytest.fixture
def looped(run):
    """A run with a loop in its log."""
    lines = [CANDIDATE, REFUSED, BETWEEN, VERIFIED, CORRECTION]
    (run / "loops.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run


def test_each_suspicion_has_a_picture(looped, capsys):
    assert main(ExplainLoopsOptions(looped)) == 0
    (picture,) = (looped / "loops").iterdir()
    assert picture.name == "frame000008_frame000001.png"
    # Wide enough for the lines below.
    assert cv2.imread(str(picture)).shape[1] > 2 * 480
    printed = capsys.readouterr().out
    assert "2 loop candidates, 1 of them accepted" in printed
    assert "submaps 0 and 1: registered, 6.4 cm" in printed
    assert "anchors corrected by up to 5.0 cm" in printed


def test_refused_ones_on_request_and_elsewhere(looped, tmp_path):
    assert main(ExplainLoopsOptions(looped, out=tmp_path / "pictures", refused=True)) == 0
    assert len(list((tmp_path / "pictures").iterdir())) == 2


def test_a_run_without_loops_has_nothing_to_draw(run, capsys):
    assert main(ExplainLoopsOptions(run)) == 0
    assert "0 loop candidates" in capsys.readouterr().out
    assert not (run / "loops").exists()


def test_what_cannot_be_read_is_named(looped, tmp_path):
    with pytest.raises(RunFolderError, match="contains no run"):
        main(ExplainLoopsOptions(tmp_path))
    (looped / "loops.jsonl").write_text("no json\n{}\n")
    with pytest.raises(FormatError, match=r"loops\.jsonl"):
        main(ExplainLoopsOptions(looped))


def test_a_verdict_belongs_to_its_frames_or_its_submaps():
    inside = CANDIDATE | {"query_submap": 0}
    other = WITHIN | {"match": 5}
    assert results_of(inside, [other, WITHIN, BETWEEN]) == [WITHIN]
    taken, against = WITHIN | {"accepted": True}, WITHIN | {"kind": "consistency"}
    assert results_of(inside, [taken, other, against]) == [taken, against]
    assert summary([inside, taken, against])[1:] == ["frames 8 and 1: rejected, no match"]
    assert results_of(CANDIDATE, [WITHIN, BETWEEN, BETWEEN | {"first": 2}]) == [BETWEEN]
    another = VERIFIED | {"match": 2}
    assert results_of(CANDIDATE, [BETWEEN, VERIFIED, another]) == [BETWEEN, VERIFIED]


def test_the_summary_contains_rejected_candidates():
    lines = summary(
        [CANDIDATE, WITHIN, BETWEEN | {"accepted": False, "reason": "only 3 % overlap"}]
    )
    assert lines[1:] == [
        "frames 8 and 1: rejected, no match",
        "submaps 0 and 1: only 3 % overlap, 6.4 cm and 0.57 degrees from odometry",
    ]
