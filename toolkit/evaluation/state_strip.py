"""The states of all frames as a strip of inline SVG; colours come from the CSS of the page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from toolkit.evaluation.frame_states import FrameState, StateRange, ranges

_WIDTH, _HEIGHT, _LABELS = 1000.0, 22.0, 16.0
# A range of few frames of a long sequence must remain visible.
_MIN_WIDTH = 1.5
# Ranges drawn later cover earlier ones: what is rare and bad comes last.
_ORDER = ("tracked", "dropped", "doubtful", "lost")


def state_strip(states: Sequence[FrameState]) -> str:
    """Return an SVG element with one section per range of frames; empty without frames.

    Sections have the class of their state. Tracked frames of separate parts of the map have the
    class "other", and the tooltip of a section shows indices and reason.
    """
    if not states:
        return ""
    first, last = states[0].index, states[-1].index
    scale = _WIDTH / (last - first + 1)
    sections = []
    for group in sorted(ranges(states), key=lambda group: _ORDER.index(group.state)):
        x = scale * (group.first - first)
        width = max(_MIN_WIDTH, scale * (group.last - group.first + 1))
        sections.append(
            f'<rect class="{_css_class(group)}" x="{min(x, _WIDTH - width):.2f}" y="0" '
            f'width="{width:.2f}" height="{_HEIGHT:g}"><title>{escape(_title(group))}</title>'
            "</rect>"
        )
    y = _HEIGHT + _LABELS - 3.0
    sections += [
        f'<text x="0" y="{y:g}">{first}</text>',
        f'<text class="end" x="{_WIDTH:g}" y="{y:g}">{last}</text>',
    ]
    return (
        f'<svg class="states" viewBox="0 0 {_WIDTH:g} {_HEIGHT + _LABELS:g}" role="img" '
        f'aria-label="states of the frames">{"".join(sections)}</svg>'
    )


def _css_class(group: StateRange) -> str:
    return "other" if group.state == "tracked" and group.part else group.state


def _title(group: StateRange) -> str:
    part = f", part {group.part}" if group.part else ""
    reason = f": {group.reason}" if group.reason else ""
    return f"frames {group.indices}, {group.state}{part}{reason}"
