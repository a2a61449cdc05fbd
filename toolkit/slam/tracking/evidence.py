"""Evidence for the pose of a frame that does not depend on the alignment that is judged.

Residuals cannot distinguish a right pose from a wrong one: alignment has minimised them, a wrong
minimum in a place of similar shape has moderate ones, and robust scales leave out whatever
contradicts.
The similarity of the frame and the rendered map can be compared between poses, scenes and cameras.
In all recordings and rooms at strides 1 to 8, the textures of rightly tracked frames correlate by
0.65 or more, and 79 % or more of the depth agrees with the map. At wrong poses, one of the two is
lower: the correlation is below 0.5, or the agreement below 75 %.
"""

from __future__ import annotations

import math

from toolkit.slam.tracking.result import TrackingResult
from toolkit.splatting.alignment.similarity import Similarity

# Fewer textured blocks give no reliable correlation; it then has a neutral value.
_MIN_BLOCKS, _NEUTRAL = 4, 0.5
# Below these, a pose is doubtful: median correlation of the textures of frame and map, fraction of
# the frame's depth that the map covers, and fraction of that which agrees with the map.
_MIN_CORRELATION, _MIN_COVERED, _MIN_AGREEMENT = 0.6, 0.15, 0.75
# A pose with this evidence is right, so that no other one is looked for.
_CLEAR_CORRELATION, _CLEAR_LOW_CORRELATION = 0.88, 0.7
_CLEAR_AGREEMENT, _CLEAR_COVERED = 0.85, 0.4
# Right poses that are neither clear nor near the predicted ones have an agreement of 93 % or more,
# at strides 3 to 40 of three recordings; the best wrong one had 88 %.
_UNEXPECTED_AGREEMENT = 0.9
# A frame of which the map covers less becomes a keyframe.
_SOON_UNCOVERED = 0.5


def quality(similarity: Similarity | None) -> float:
    """Quality of a pose from 0 to 1, which can be compared between poses of one frame."""
    return 0.0 if similarity is None else math.sqrt(similarity.covered) * likeness(similarity)


def likeness(similarity: Similarity | None) -> float:
    """Likeness of a frame to what the map shows of it at a pose, from 0 to 1."""
    if similarity is None:
        return 0.0
    correlation = _NEUTRAL
    if similarity.blocks >= _MIN_BLOCKS:
        # Slightly wrong poses show in the blocks that fit worst.
        correlation = 0.5 * (similarity.correlation + similarity.low_correlation)
    return max(correlation, 0.0) * similarity.agreeing


def is_clear(similarity: Similarity | None, min_covered: float = _CLEAR_COVERED) -> bool:
    """Whether the evidence for a pose is so good that no other pose needs to be considered.

    Args:
        min_covered: minimum fraction of the frame that the other view shows.
    """
    return (
        similarity is not None
        and similarity.blocks >= _MIN_BLOCKS
        and similarity.correlation >= _CLEAR_CORRELATION
        and similarity.low_correlation >= _CLEAR_LOW_CORRELATION
        and similarity.agreeing >= _CLEAR_AGREEMENT
        and similarity.covered >= min_covered
    )


def doubt_reason(similarity: Similarity | None) -> str:
    """Why a pose may be wrong; empty if the evidence suffices."""
    if similarity is None:
        return ""
    if similarity.covered < _MIN_COVERED:
        return f"the map covers only {100 * similarity.covered:.0f} % of the frame"
    if similarity.blocks >= _MIN_BLOCKS and similarity.correlation < _MIN_CORRELATION:
        return f"frame and map correlate by only {similarity.correlation:.2f}"
    if similarity.agreeing < _MIN_AGREEMENT:
        return f"only {100 * similarity.agreeing:.0f} % of the depth agrees with the map"
    return ""


def unexpected_reason(similarity: Similarity | None) -> str:
    """Why a pose far from the predicted one may be wrong; empty if the evidence suffices."""
    if similarity is None or similarity.agreeing >= _UNEXPECTED_AGREEMENT:
        return ""
    share = 100 * similarity.agreeing
    return f"only {share:.0f} % of the depth agrees with the map after an unexpected motion"


def shows_much_unmapped(result: TrackingResult | None) -> bool:
    """Whether the map covers so little of a tracked frame that the next one may be lost.

    A camera that moves backwards sees all of the last keyframe, and much else.
    """
    similarity = None if result is None or result.lost else result.similarity
    return similarity is not None and similarity.covered < _SOON_UNCOVERED
