"""States of frames: grouped into ranges, summarised in few lines, and drawn as a strip."""

from __future__ import annotations

from toolkit.runs.evaluation.frame_states import (
    FrameState,
    PartSummary,
    frame_metrics,
    part_lines,
    ranges,
    summary_lines,
)
from toolkit.slam.result import Loss


def sequence(text: str, reasons: dict[int, str] | None = None) -> list[FrameState]:
    """A frame per letter: t(racked), d(oubtful), l(ost), x (dropped), or the number of a part."""
    kinds = {"t": "tracked", "d": "doubtful", "l": "lost", "x": "dropped"}
    return [
        FrameState(
            index,
            kinds.get(letter, "tracked"),
            (reasons or {}).get(index, ""),
            None if letter == "l" else int(letter) if letter.isdigit() else 0,
        )
        for index, letter in enumerate(text)
    ]


def test_ranges_divide_states_parts_and_reasons_but_not_the_numbers_in_them():
    reasons = {1: "only 4 % is visible", 2: "only 7.5 % is visible", 3: "too dark"}
    found = ranges(sequence("tllld1", reasons))
    assert [(r.first, r.last, r.frames, r.state, r.part) for r in found] == [
        (0, 0, 1, "tracked", 0),
        (1, 2, 2, "lost", None),
        (3, 3, 1, "lost", None),
        (4, 4, 1, "doubtful", 0),
        (5, 5, 1, "tracked", 1),
    ]
    assert found[1].reason == "only 4 % is visible" and found[1].indices == "1-2"


def test_a_good_run_has_no_summary():
    assert summary_lines(sequence("ttxt"), [PartSummary(0, (0,), 4)]) == []


def test_the_longest_ranges_are_listed_in_order_and_the_others_counted():
    states = sequence("lttlltllltlttltllll", {6: "dark"})
    (line,) = summary_lines(states, [PartSummary(0, (0,), 7)])
    # 3-4, 7-8 and 15-18 are the longest; of the single frames, the first one is listed.
    assert line == "12 of 19 frames are lost: 0, 3-4, 7-8, 15-18, and 3 more."


def test_parts_name_their_frames_between_those_of_others():
    states = sequence("00l11l002")
    parts = [
        PartSummary(0, (0, 2), 4, 0, 7),
        PartSummary(1, (1,), 2, 3, 4, Loss(2, "dark")),
        PartSummary(2, (3,), 1, 8, 8),
    ]
    first, second = part_lines(states, parts)
    assert first.startswith("Frames 3-4 (2 frames) form a separate part, parts/1;")
    assert first.endswith("is unknown: the camera was lost at frame 2 (dark).")
    assert second.startswith("Frame 8 forms a separate part, parts/2;")
    assert second.endswith("relative to the main part is unknown.")
    swapped = [PartSummary(0, (1,), 2), PartSummary(1, (0, 2), 4, 0, 7)]
    (line,) = part_lines(sequence("11l00l11"), swapped)
    assert line.startswith("Frames 0-1, 6-7 (4 frames) form")


def test_many_parts_are_counted_and_an_unreached_map_is_named():
    states = sequence("0012345")
    parts = [PartSummary(0, (0,), 2, 0, 1)]
    parts += [PartSummary(n, (n,), 1, n + 1, n + 1) for n in range(1, 6)]
    lines = part_lines(states, parts)
    assert len(lines) == 4
    assert lines[-1] == (
        "2 more frames are in 2 more separate parts, parts/4 to parts/5; see frames.json."
    )
    (line,) = part_lines(sequence("00"), [PartSummary(0, (2,), 2, 0, 1), PartSummary(1, (0, 1), 0)])
    assert line == "No frame was relocalised in the loaded map; it is not part of the result."


def test_metrics_count_frames_by_state_and_part():
    parts = [PartSummary(0, (0,), 5), PartSummary(1, (1,), 2)]
    assert frame_metrics(sequence("tdlx11d"), parts, keyframes=1) == {
        "total": 7,
        "keyframes": 1,
        "doubtful": 2,
        "lost": 1,
        "in_other_parts": 2,
    }
