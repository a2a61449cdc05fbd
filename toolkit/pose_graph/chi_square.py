"""The chi-square distribution, by which residuals are judged."""

from __future__ import annotations

from scipy.special import gammaincinv


def quantile(confidence: float, degrees: int) -> float:
    """The value that a sum of `degrees` squared unit normals stays below so often.

    Raises:
        ValueError: the confidence is not between 0 and 1.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
    return 2.0 * float(gammaincinv(0.5 * degrees, confidence))
