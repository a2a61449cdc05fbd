"""An atlas of one submap, and keyframes of labelled views, for scenes that grow with a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from toolkit.base.frame import NullRecorder
from toolkit.base.keyframe import Keyframe
from toolkit.scene.growing.listener import SceneListener
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.taxonomy import Taxonomy


class OneSubmap:
    """What the scene reads of an atlas with one submap."""

    def __init__(self) -> None:
        self.active, self.keyframes, self.pose = 0, [], np.eye(4)

    def __len__(self) -> int:
        return 1

    def T_world_submap(self, number: int) -> np.ndarray:
        return self.pose


def labelled_keyframe(view, index: int, T_world_room: np.ndarray | None = None) -> Keyframe:
    """The keyframe of a view of `box_room`, with the classes of its surfaces."""
    T = view.T_world_camera if T_world_room is None else T_world_room @ view.T_world_camera
    keyframe = Keyframe.from_frame(replace(view.frame, index=index), T)
    keyframe.class_ids = torch.from_numpy(view.classes.astype(np.int16))
    return keyframe


def new_scene(taxonomy: Taxonomy, tracker: InstanceTracker | None = None) -> SceneListener:
    """A scene without keyframes."""
    return SceneListener(taxonomy, tracker, NullRecorder())


def grown(keyframes: list[Keyframe], scene: SceneListener, atlas: OneSubmap) -> SceneListener:
    """The scene after these keyframes."""
    for keyframe in keyframes:
        atlas.keyframes.append(keyframe)
        scene.frame_added(atlas, 1.0)
    return scene
