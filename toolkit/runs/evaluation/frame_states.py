"""The state of every frame of a run (tracked, doubtful, lost or dropped), and summaries of it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

from toolkit.runs.evaluation.metrics import Metrics
from toolkit.slam.result import Loss, SlamResult

State = Literal["tracked", "doubtful", "lost", "dropped"]
# Ranges of a line of the summary; the others are counted.
_MAX_RANGES = 4
# Separate parts that are described in a line each; the others are counted.
_MAX_PARTS = 3


@dataclass(frozen=True)
class FrameState:
    """What became of a frame.

    Attributes:
        index: in the sequence.
        state: "doubtful" for a pose that may be wrong, "lost" without a pose, "dropped" if the
            frame was not processed and has the pose of the frame before.
        reason: why it is doubtful or lost; otherwise empty.
        part: the part of the map that the pose refers to, 0 for the main part; None if lost.
    """

    index: int
    state: State
    reason: str = ""
    part: int | None = None


@dataclass(frozen=True)
class StateRange:
    """Consecutive frames of the same state, for similar reasons.

    Attributes:
        first, last: frame indices.
        frames: number of frames.
        state: of all of them.
        reason: of the first one.
        part: of all of them; None if they are lost.
    """

    first: int
    last: int
    frames: int
    state: State
    reason: str
    part: int | None

    @property
    def indices(self) -> str:
        """The frame indices as text, for instance "120-134"."""
        return _indices(self.first, self.last)


@dataclass(frozen=True)
class PartSummary:
    """A part of the map, without its content.

    Attributes:
        number: 0 for the main part.
        submaps: numbers of its submaps.
        frames: number of frames with a pose in it.
        first, last: its first and last frame; None without frames.
        loss: where the camera was lost; None for the main part, and if it is not known.
    """

    number: int
    submaps: tuple[int, ...]
    frames: int
    first: int | None = None
    last: int | None = None
    loss: Loss | None = None


def frame_states(result: SlamResult) -> list[FrameState]:
    """List the states of all frames of a run, in order."""
    parts = dict.fromkeys(result.frame_indices, 0)
    numbers = {part: number for number, part in enumerate(result.parts)}
    for other in result.other_parts:
        parts |= dict.fromkeys(other.frames.indices, numbers[other.submaps])
    dropped = set(result.dropped_frames)
    states = [FrameState(index, "lost", why) for index, why in result.lost_frames.items()]
    states += [FrameState(index, "doubtful", why) for index, why in result.doubtful_frames.items()]
    for index, part in parts.items():
        states.append(FrameState(index, "dropped" if index in dropped else "tracked", part=part))
    return sorted(states, key=lambda state: state.index)


def part_summaries(result: SlamResult) -> list[PartSummary]:
    """Summarise the parts of the map, the main part first."""
    frames = {tuple(result.parts[0]): result.frame_indices} if result.parts else {}
    frames |= {other.submaps: other.frames.indices for other in result.other_parts}
    losses = {other.submaps: other.loss for other in result.other_parts}
    summaries = []
    for number, part in enumerate(result.parts):
        own = frames.get(part, [])
        first, last = (own[0], own[-1]) if own else (None, None)
        summaries.append(PartSummary(number, part, len(own), first, last, losses.get(part)))
    return summaries


def ranges(states: Iterable[FrameState]) -> list[StateRange]:
    """Group consecutive frames of the same state and part, and of reasons that differ in numbers
    only."""

    def kind(state: FrameState) -> tuple[State, int | None, str]:
        return state.state, state.part, re.sub(r"\d+(\.\d+)?", "#", state.reason)

    found = []
    for _, group in groupby(states, key=kind):
        rows = list(group)
        first = rows[0]
        found.append(
            StateRange(
                first.index, rows[-1].index, len(rows), first.state, first.reason, first.part
            )
        )
    return found


def frame_metrics(
    states: Sequence[FrameState], parts: Sequence[PartSummary], keyframes: int
) -> Metrics:
    """Numbers of frames by their state.

    Args:
        keyframes: number of keyframes.
    """
    counts = Counter(state.state for state in states)
    return {
        "total": len(states),
        "keyframes": keyframes,
        "doubtful": counts["doubtful"],
        "lost": counts["lost"],
        "in_other_parts": sum(part.frames for part in parts if part.number > 0),
    }


def summary_lines(states: Sequence[FrameState], parts: Sequence[PartSummary]) -> list[str]:
    """Describe lost and doubtful frames and separate parts in a few lines; none if all is well."""
    lines = []
    grouped = ranges(states)
    for name, explanation in (("lost", ""), ("doubtful", ", their poses may be wrong")):
        chosen = [group for group in grouped if group.state == name]
        if chosen:
            count = sum(group.frames for group in chosen)
            text = f"{count} of {len(states)} frames are {name}{explanation}"
            lines.append(f"{text}: {_listed(chosen)}.")
    return lines + part_lines(states, parts)


def part_lines(states: Sequence[FrameState], parts: Sequence[PartSummary]) -> list[str]:
    """Describe the separate parts of a map in a line each; further ones are counted."""
    lines = []
    separate = [part for part in parts if part.number > 0 and part.frames]
    for part in separate[:_MAX_PARTS]:
        loss = part.loss
        why = "" if loss is None else f": the camera was lost at frame {loss.index} ({loss.reason})"
        indices = ", ".join(_runs(states, part.number))
        which = f"Frames {indices} ({part.frames} frames) form"
        if part.frames == 1:
            which = f"Frame {indices} forms"
        lines.append(
            f"{which} a separate part, parts/{part.number}; its position relative to the main part "
            f"is unknown{why}."
        )
    others = separate[_MAX_PARTS:]
    if others:
        frames = sum(part.frames for part in others)
        lines.append(
            f"{frames} more frames are in {len(others)} more separate parts, "
            f"parts/{others[0].number} to parts/{others[-1].number}; see frames.json."
        )
    if any(not part.frames for part in parts):
        lines.append("No frame was relocalised in the loaded map; it is not part of the result.")
    return lines


def _runs(states: Sequence[FrameState], part: int) -> list[str]:
    """Index ranges of a part between frames of other parts; lost frames do not divide them."""
    posed = [state for state in states if state.part is not None]
    texts = []
    for number, group in groupby(posed, key=lambda state: state.part):
        rows = list(group)
        if number == part:
            texts.append(_indices(rows[0].index, rows[-1].index))
    return texts


def _indices(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}-{last}"


def _listed(groups: Sequence[StateRange]) -> str:
    """The longest ranges with their reasons, in order."""
    longest = sorted(groups, key=lambda group: -group.frames)[:_MAX_RANGES]
    shown = sorted(longest, key=lambda group: group.first)
    texts = [
        f"{group.indices} ({group.reason})" if group.reason else group.indices for group in shown
    ]
    more = len(groups) - len(shown)
    return ", ".join(texts) + (f", and {more} more" if more else "")
