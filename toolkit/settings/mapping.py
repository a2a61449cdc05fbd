"""Settings of the mapper."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class KeyframeSettings(Settings):
    """When a tracked frame becomes a keyframe."""

    interval: int = Field(5, ge=1, description="every so many frames (G: d_k)")
    min_overlap: float = Field(0.95, ge=0, le=1, description="sooner below this overlap")


class SeedingSettings(Settings):
    """How a pixel becomes a Gaussian."""

    radius: float = Field(0.6, gt=0, description="standard deviation in units of d / f")
    opacity: float = Field(0.95, gt=0, lt=1, description="start opacity")
    max_cell: Literal[1, 2, 4] = Field(2, description="pixels a side on plain surfaces")
    flat_colour: float = Field(0.04, ge=0, description="colour range that counts as plain")
    flat_depth: float = Field(0.005, ge=0, description="bend that counts as plane, of depth")
    choice: Literal["cells", "uniform", "semantic"] = Field(
        "cells", description="which pixels seed: all in cells, or a random share (G: semantic)"
    )
    share: float = Field(0.5, gt=0, le=1, description="of the pixels, where chosen at random")


class LearningRateSettings(Settings):
    """Step sizes of the map's optimiser."""

    means: float = Field(0.04, ge=0, description="in units of the Gaussian's radius")
    log_radii: float = Field(0.01, ge=0)
    opacity_logits: float = Field(0.05, ge=0)
    colours: float = Field(0.01, ge=0)
    features: float = Field(1.0, ge=0, description="logits")
    epsilon: float = Field(0.05, gt=0, description="gradients below it hardly move anything")
    settle_steps: float = Field(60.0, ge=0, description="rates halve after so many steps")


class LossSettings(Settings):
    """Weights of the mapping loss (H-24 by default; G-3: colour 1, depth 0.5)."""

    colour: float = Field(0.5, ge=0)
    depth: float = Field(1.0, ge=0)
    silhouette: float = Field(0.02, ge=0, description="fills surfaces that were measured")
    structure: float = Field(0.2, ge=0, le=1, description="share of SSIM in the colour term")
    colour_scale: float = Field(0.02, gt=0, description="quadratic below it, [0, 1]")
    depth_scale_m: float = Field(0.005, gt=0, description="quadratic below it, m at 1 m")
    min_silhouette: float = Field(0.5, ge=0, le=1, description="depth counts above it")


class ConsensusSettings(Settings):
    """When a segment of a keyframe's labels is overruled by the others."""

    rounds: int = Field(2, ge=0, description="of correcting and voting again; 0 only votes")
    min_views: float = Field(1.5, ge=0, description="that told the map of a pixel")
    min_share: float = Field(0.1, ge=0, le=1, description="of a segment, known to other views")
    margin: float = Field(0.1, ge=0, le=1, description="by which the map must be surer")


class MappingSettings(Settings):
    """The mapper."""

    iterations: int = Field(12, ge=0, description="steps a keyframe, while mapping")
    first_iterations: int = Field(40, ge=0, description="steps on the first keyframe")
    final_iterations: int = Field(10, ge=0, description="steps a keyframe at the end")
    final_on_surfaces: bool = Field(True, description="these move centres along surfaces alone")
    final_poses: bool = Field(False, description="these move keyframes too (G, stage 1)")
    final_feature: float = Field(0.0, ge=0, description="their feature term (G: 0.5)")
    window: int = Field(8, ge=1, description="keyframes a mapping call works on")
    newest_share: float = Field(0.4, gt=0, le=1, description="of the steps, for the newest")
    min_overlap: float = Field(0.15, ge=0, le=1, description="that joins the window")
    min_silhouette: float = Field(0.85, gt=0, lt=1, description="seed below it (tau_sil)")
    depth_floor: float = Field(0.03, ge=0, description="depth error that seeds, of depth")
    depth_factor: float = Field(20.0, ge=0, description="the same in medians of the error")
    fuse_depth: bool = Field(True, description="centres at the mean of what is measured")
    centred: bool = Field(True, description="until refined, colours fit where Gaussians are")
    bundle_adjustment: bool = Field(False, description="optimise keyframe poses with the map")
    pose_translation_m: float = Field(1e-4, gt=0, description="its step, m")
    pose_rotation_rad: float = Field(5e-5, gt=0, description="its step, rad")
    min_opacity: float = Field(0.005, ge=0, description="prune below it")
    max_radius_m: float = Field(0.5, gt=0, description="prune beyond it")
    keyframes: KeyframeSettings = KeyframeSettings()
    seeding: SeedingSettings = SeedingSettings()
    rates: LearningRateSettings = LearningRateSettings()
    loss: LossSettings = LossSettings()
    consensus: ConsensusSettings = ConsensusSettings()
