"""The chi-square distribution, by which residuals are judged."""

from __future__ import annotations

from scipy.special import gammaincinv


def quantile(confidence: float, degrees: int) -> float:
    """The value that a sum of `degrees` squared unit normals stays below so often.

    Args:
        confidence: in (0, 1]; at 1 no value is large enough, and the answer is infinite.

    Raises:
        ValueError: the confidence is outside.
    """
    if not 0.0 < confidence <= 1.0:
        raise ValueError(f"confidence must be above 0 and at most 1, got {confidence}")
    return 2.0 * float(gammaincinv(0.5 * degrees, confidence))
