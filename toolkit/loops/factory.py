"""Loop detection from settings."""

from __future__ import annotations

from toolkit.features.sources import ViewDescriber
from toolkit.loops.candidates import CandidateFinder, CandidateOptions
from toolkit.loops.landmarks import LandmarkOptions
from toolkit.settings.loops import LoopSettings


def build_candidate_finder(settings: LoopSettings, describer: ViewDescriber) -> CandidateFinder:
    """The finder of loop candidates for a describer's descriptors.

    Raises:
        DependencyError: FAISS cannot be loaded.
    """
    return CandidateFinder(
        describer.dimensions,
        describer.threshold,
        CandidateOptions(**settings.candidates.model_dump()),
        LandmarkOptions(**settings.landmarks.model_dump()),
    )
