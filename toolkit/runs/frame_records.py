"""The content of frames.json: frames, their states, keyframes, submaps and parts of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, get_args

from toolkit.evaluation.frame_states import FrameState, PartSummary, State
from toolkit.evaluation.run_metrics import TrackedFrame
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


def read_states(content: dict[str, Any]) -> list[FrameState]:
    """Read the states of all frames; runs of older versions have no doubtful frames.

    Raises:
        KeyError, TypeError, ValueError: the content is malformed.
    """
    if "states" in content:
        return [_state(row) for row in content["states"]]
    states = [FrameState(int(row["index"]), "tracked", part=0) for row in content["frames"]]
    states += [FrameState(int(index), "lost") for index in content["lost"]]
    return sorted(states, key=lambda state: state.index)


def read_parts(content: dict[str, Any]) -> list[PartSummary]:
    """Read the parts of the map; runs of older versions have one.

    Raises:
        KeyError, TypeError, ValueError: the content is malformed.
    """
    if "parts" not in content:
        numbers = tuple(int(row["number"]) for row in content.get("submaps", []))
        return [PartSummary(0, numbers, len(content["frames"]))]
    parts = []
    for row in content["parts"]:
        loss = row.get("loss")
        parts.append(
            PartSummary(
                int(row["number"]),
                tuple(int(number) for number in row["submaps"]),
                int(row["frames"]),
                row.get("first"),
                row.get("last"),
                None if loss is None else Loss(int(loss["index"]), str(loss["reason"])),
            )
        )
    return parts


def _state(row: dict[str, Any]) -> FrameState:
    if row["state"] not in get_args(State):
        raise ValueError(f"unknown state {row['state']!r}")
    part = row.get("part")
    reason = str(row.get("reason", ""))
    return FrameState(int(row["index"]), row["state"], reason, None if part is None else int(part))


def _part_row(part: PartSummary) -> dict[str, Any]:
    return asdict(part) | {"submaps": list(part.submaps)}
