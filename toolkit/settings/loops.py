"""Settings of loop closure."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class CandidateSettings(Settings):
    """Which keyframes may show a place seen before."""

    search_every: int = Field(6, ge=1, description="keyframes from one search to the next")
    considered: int = Field(10, ge=1, description="nearest keyframes looked at")
    kept: int = Field(3, ge=1, description="candidates that go on to verification (G: 1)")
    threshold: Literal["fixed", "adaptive"] = Field(
        "fixed", description="the encoder's own, or what the keyframe's neighbours look like"
    )
    distance: float | None = Field(
        None, gt=0, le=2, description="of descriptors, Euclidean; the encoder's own if unset"
    )
    adaptive_quantile: float = Field(0.5, ge=0, le=1, description="of the neighbours' distances")
    adaptive_limit: float = Field(1.5, gt=0, description="at most so many times the fixed one")
    min_gap_frames: int = Field(30, ge=1, description="between query and match")
    min_gap_m: float = Field(0.5, ge=0, description="between them along the path, m")
    max_landmark_distance: float = Field(
        0.7, gt=0, description="of unit landmark vectors; from 1.42 on all pass"
    )


class LandmarkSettings(Settings):
    """How the classes in view tell one place from another."""

    counted: Literal["pixels", "gaussians"] = Field(
        "pixels", description="labelled pixels of a keyframe, or the Gaussians it observes (G-7)"
    )
    weighting: Literal["sqrt", "linear", "paper"] = Field(
        "sqrt", description="of a class's share of the view; paper is G-7 as printed"
    )
    min_count: int = Field(10, ge=0, description="minimum count of a class that a keyframe sees")


class LoopSettings(Settings):
    """Loop closure."""

    candidates: CandidateSettings = CandidateSettings()
    landmarks: LandmarkSettings = LandmarkSettings()
