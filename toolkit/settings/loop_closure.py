"""Settings of loop closure, from descriptors to pose graphs."""

from __future__ import annotations

from pydantic import Field

from toolkit.settings.base import Settings
from toolkit.settings.features import FeatureSettings
from toolkit.settings.loops import CandidateSettings, LandmarkSettings
from toolkit.settings.pose_graph import PoseGraphSettings
from toolkit.settings.registration import RegistrationSettings


class VerificationSettings(Settings):
    """What a registration must show to be a loop."""

    min_overlap: float = Field(0.3, ge=0, le=1, description="share of the source in view")
    min_inliers: float = Field(0.8, ge=0, le=1, description="of it on the same surface")
    min_class_agreement: float = Field(0.7, ge=0, le=1, description="of it of the same class")
    max_intensity_residual: float = Field(0.1, gt=0, description="photometric scale, [0, 1]")
    max_depth_residual_m: float = Field(0.02, gt=0, description="geometric scale at 1 m, m")
    min_information: float = Field(1e4, ge=0, description="smallest eigenvalue, 1 / m^2")


class RelocalisationSettings(Settings):
    """How a lost camera is looked for."""

    tries: int = Field(5, ge=1, description="keyframes matched with the frame")
    speed_m_s: float = Field(2.0, ge=0, description="of the camera; beyond it, not at once")
    slack_m: float = Field(2.0, ge=0, description="as far it is looked for in any case, m")
    min_visible: float = Field(0.4, ge=0, le=1, description="share that must be explained")
    max_intensity_residual: float = Field(0.1, gt=0, description="photometric scale, [0, 1]")
    patience: int = Field(15, ge=1, description="lost frames before a new submap begins")


class ClosingSettings(Settings):
    """Which loops are closed."""

    within: bool = Field(True, description="inside submaps, between keyframes")
    between: bool = Field(True, description="between submaps, by registration")
    min_visible: float = Field(0.4, ge=0, le=1, description="share of a pair's view in common")
    min_shared: float = Field(0.3, ge=0, le=1, description="of a suspected pair's views")
    max_partners: int = Field(8, ge=0, description="of a submap, when overlaps are measured")
    drift_confidence: float = Field(
        0.99, gt=0, lt=1, description="of loops against the keyframes that they move"
    )
    mapping_iterations: int = Field(
        0, ge=0, description="mapping iterations per keyframe moved inside a submap (G: 10)"
    )


class LoopClosureSettings(Settings):
    """Loop closure; without `use` drift stays."""

    use: bool = Field(True, description="find and close loops")
    features: FeatureSettings = FeatureSettings()
    candidates: CandidateSettings = CandidateSettings()
    landmarks: LandmarkSettings = LandmarkSettings()
    registration: RegistrationSettings = RegistrationSettings()
    verification: VerificationSettings = VerificationSettings()
    closing: ClosingSettings = ClosingSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    pose_graph: PoseGraphSettings = PoseGraphSettings()
