"""The content of frames.json: frames, their states, keyframes, submaps and parts of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, get_args

from toolkit.runs.evaluation.frame_states import FrameState, PartSummary, State
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.slam.result import Loss, SlamResult


def frame_records(
    result: SlamResult,
    tracked: Sequence[TrackedFrame],
    states: Sequence[FrameState],
    parts: Sequence[PartSummary],
) -> dict[str, Any]:
    """Return the content of frames.json.

    Args:
        tracked: frames of the main part, as in trajectory.txt.
        states: states of all frames of the sequence.
        parts: parts of the map.
    """
    part_of = {number: part.number for part in parts for number in part.submaps}
    return {
        "frames": [
            {
                "index": f.index,
                "timestamp_s": f.timestamp_s,
                **asdict(f.exposure),
                "held_out": f.held_out,
            }
            for f in tracked
        ],
        "states": state_rows(result, states),
        "lost": list(result.lost_frames),
        "keyframes": result.keyframe_indices,
        "parts": [_part_row(part) for part in parts],
        "submaps": [
            {
                "number": submap.number,
                "part": part_of.get(submap.number, 0),
                "T_world_submap": submap.T_world_submap.tolist(),
                "keyframes": submap.keyframe_indices,
                "lost": not submap.readable,
                "exposure": asdict(submap.exposure),
            }
            for submap in result.submaps
        ],
        "allocation": [verdict.values() for verdict in result.allocation],
        "units_per_metre": result.units_per_metre,
    }


def state_rows(result: SlamResult, states: Sequence[FrameState]) -> list[dict[str, Any]]:
    """Return one row per frame of the sequence: its state, reason, part and role."""
    keyframes = set(result.keyframe_indices)
    rows = []
    for state in states:
        row: dict[str, Any] = {"index": state.index, "state": state.state}
        if state.reason:
            row["reason"] = state.reason
        if state.part is not None:
            row["part"] = state.part
        if state.index in keyframes:
            row["keyframe"] = True
            row["steps"] = result.keyframe_steps.get(state.index, 0)
        rows.append(row)
    return rows


def read_part(row: dict[str, Any]) -> PartSummary:
    """Read a part of the map.

    Raises:
        KeyError, TypeError, ValueError: the row is malformed.
    """
    loss = row["loss"]
    return PartSummary(
        int(row["number"]),
        tuple(int(number) for number in row["submaps"]),
        int(row["frames"]),
        row["first"],
        row["last"],
        None if loss is None else Loss(int(loss["index"]), str(loss["reason"])),
    )


def read_state(row: dict[str, Any]) -> FrameState:
    """Read the state of a frame.

    Raises:
        KeyError, TypeError, ValueError: the row is malformed.
    """
    if row["state"] not in get_args(State):
        raise ValueError(f"unknown state {row['state']!r}")
    part = row.get("part")
    reason = str(row.get("reason", ""))
    return FrameState(int(row["index"]), row["state"], reason, None if part is None else int(part))


def _part_row(part: PartSummary) -> dict[str, Any]:
    return asdict(part) | {"submaps": list(part.submaps)}
