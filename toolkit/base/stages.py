"""Stages of a run whose times are recorded, and the columns in which tables sum them."""

from __future__ import annotations

from enum import StrEnum


class Stage(StrEnum):
    """A recorded stage; stages may be nested."""

    # The whole run, one after another.
    MOTION = "motion"
    ONLINE = "online"
    FINISH = "finish"
    # One frame, and what it consists of.
    FRAME = "frame"
    RECTIFICATION = "rectification"
    DENOISING = "denoising"
    TRACKING = "tracking"
    RELOCALISATION = "relocalisation"
    LABELLING = "labelling"
    INSTANCES = "instances"
    SCENE_GRAPH = "scene graph"
    DEPTH_PRIOR = "depth prior"
    PLACING = "placing"
    MAPPING = "mapping"
    LOOP_DETECTION = "loop detection"
    LOOPS_WITHIN = "loops within submaps"
    LOOPS_BETWEEN = "loops between submaps"
    # After the last frame.
    REFINEMENT = "refinement"
    ANCHOR_REGISTRATION = "anchor registration"
    DEPTH_FUSION = "depth fusion"
    FREE_SPACE = "free space"
    HOLE_FILLING = "hole filling"
    INSTANCE_VOTES = "instance votes"
    # Details of tracking and mapping.
    TRACKING_RENDER = "tracking render"
    TRACKING_ALIGN = "tracking align"
    TRACKING_BACKWARD = "tracking backward"
    TRACKING_EVIDENCE = "tracking evidence"
    TRACKING_FEATURES = "tracking features"
    TRACKING_SEARCH = "tracking search"
    SEEDING = "seeding"
    EXPOSURE = "exposure"
    MAP_FORWARD = "map forward"
    MAP_LOSS = "map loss"
    MAP_SEMANTIC_LOSS = "map semantic loss"
    MAP_BACKWARD = "map backward"
    MAP_UPDATE = "map update"
    MAP_CONSENSUS = "map consensus"


class Column(StrEnum):
    """A column of time per frame: its stages are never nested in each other."""

    TRACKING = "tracking"
    LABELLING = "labelling"
    MAPPING = "mapping"
    LOOPS = "loops"


COLUMNS: dict[Column, tuple[Stage, ...]] = {
    Column.TRACKING: (
        Stage.RECTIFICATION,
        Stage.DENOISING,
        Stage.TRACKING,
        Stage.RELOCALISATION,
    ),
    Column.LABELLING: (Stage.LABELLING, Stage.INSTANCES, Stage.SCENE_GRAPH),
    Column.MAPPING: (Stage.DEPTH_PRIOR, Stage.PLACING, Stage.MAPPING),
    Column.LOOPS: (Stage.LOOP_DETECTION, Stage.LOOPS_WITHIN, Stage.LOOPS_BETWEEN),
}
