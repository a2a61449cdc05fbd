"""A default is written twice, in a stage's options and in its settings: they must agree."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from toolkit.closing.parts import ClosingOptions
from toolkit.gaussians.seeding import SeedingOptions
from toolkit.loops.candidates import CandidateOptions
from toolkit.loops.landmarks import LandmarkOptions
from toolkit.loops.verification import VerificationOptions
from toolkit.losses.photometric import RgbdLossWeights
from toolkit.losses.semantic import SemanticLossWeights
from toolkit.mapping.consensus import ConsensusOptions
from toolkit.mapping.keyframes import KeyframePolicy
from toolkit.mapping.mapper import MapperOptions
from toolkit.mapping.sparse_adam import LearningRates
from toolkit.pose_graph.consistency import ConsistencyOptions
from toolkit.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.pose_graph.retraction import RetractionOptions
from toolkit.pose_graph.solver import SolverOptions
from toolkit.settings.base import Settings
from toolkit.settings.loop_closure import ClosingSettings, VerificationSettings
from toolkit.settings.loops import CandidateSettings, LandmarkSettings
from toolkit.settings.mapping import (
    ConsensusSettings,
    KeyframeSettings,
    LearningRateSettings,
    LossSettings,
    MappingSettings,
    SeedingSettings,
)
from toolkit.settings.pose_graph import (
    ConsistencySettings,
    LoopNoiseSettings,
    OdometryNoiseSettings,
    RetractionSettings,
    SolverSettings,
)
from toolkit.settings.registration import PlacementSettings
from toolkit.settings.semantics import SemanticLossSettings
from toolkit.settings.submaps import AllocationSettings, BoundarySettings
from toolkit.submaps.allocation import AllocationOptions
from toolkit.submaps.atlas import BoundaryOptions
from toolkit.tracking.placement import PlacementOptions

PAIRS = [
    (AllocationOptions(), AllocationSettings(min_divergence=0.4)),  # unset: the segmenter's
    (BoundaryOptions(), BoundarySettings()),
    (VerificationOptions(), VerificationSettings()),
    (ClosingOptions(), ClosingSettings()),
    (PlacementOptions(), PlacementSettings()),
    (MapperOptions(), MappingSettings()),
    (SeedingOptions(), SeedingSettings()),
    (ConsensusOptions(), ConsensusSettings()),
    (SemanticLossWeights(), SemanticLossSettings()),
    (LearningRates(), LearningRateSettings()),
    (RgbdLossWeights(), LossSettings()),
    (KeyframePolicy(), KeyframeSettings()),
    (LoopNoise(), LoopNoiseSettings()),
    (OdometryNoise(), OdometryNoiseSettings()),
    (ConsistencyOptions(), ConsistencySettings()),
    (SolverOptions(), SolverSettings()),
    (RetractionOptions(), RetractionSettings()),
    (CandidateOptions(), CandidateSettings()),
    (LandmarkOptions(), LandmarkSettings()),
]


@pytest.mark.parametrize(("options", "settings"), PAIRS, ids=lambda p: type(p).__name__)
def test_defaults_of_options_and_settings_are_equal(options: object, settings: Settings) -> None:
    # Whether a stage takes part at all is no value of it.
    assert asdict(options) == settings.model_dump(exclude={"use"})
