"""Quantiles of the chi-square distribution for residual tests."""

from __future__ import annotations

from scipy.special import gammaincinv


def quantile(confidence: float, degrees: int) -> float:
    """Return the chi-square quantile for `degrees` degrees of freedom.

    Args:
        confidence: probability in (0, 1]; the quantile of 1 is infinite.
        degrees: degrees of freedom.

    Raises:
        ValueError: the confidence is out of range.
    """
    if not 0.0 < confidence <= 1.0:
        raise ValueError(f"confidence must be above 0 and at most 1, got {confidence}")
    return 2.0 * float(gammaincinv(0.5 * degrees, confidence))
