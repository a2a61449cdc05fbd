"""The paper's fine registration: its loss and where its optimiser ends."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from registered_room import Scene, error, motion, moved

from toolkit.base.geometry import se3
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.registration import first_order_fine
from toolkit.slam.loops.registration.first_order_fine import (
    FirstOrderFineRegistration,
    _Objective,
)
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.mapping.view_features import ViewFeatures
from toolkit.splatting.rendering import render


def test_the_papers_optimiser_comes_near(room: Scene, renderer):
    options = RegistrationOptions(views=2)
    start = room.T_target_source @ motion(1, 0.04, 2.0)
    result = FirstOrderFineRegistration(options, renderer).register(room.target, room.source, start)
    mm, deg = error(result.T_target_source, room.T_target_source)
    assert mm < 15.0
    assert deg < 0.5
    assert result.renders == renderer.renders
    assert result.inliers > 0.9


class Thumbnails:
    """A smooth stand-in for an image encoder."""

    name, dimensions, threshold = "thumbnails", 3, 0.2

    def describe(self, images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(images, 20).flatten(1)


@pytest.mark.parametrize("source", [None, "rgb", "semantic", "both"])
def test_the_papers_loss_has_the_right_derivative(
    labelled_room: Scene, semantics, source, monkeypatch
):
    scene = labelled_room
    T_new_source = motion(6, 1.0, 80.0)
    source = moved(scene.source, T_new_source)
    keyframe = source.keyframes[1]
    camera, T_source_camera = keyframe.camera, keyframe.T_map_camera
    shown = render(
        source.gaussians,
        camera,
        se3.inverse(T_source_camera),
        features=source.gaussians.features,
    )
    # All pixels: where the mask's border moves, the loss jumps.
    monkeypatch.setattr(first_order_fine, "_MIN_SILHOUETTE", -1.0)
    options = RegistrationOptions(feature=5.0)
    view_features = None
    if source is not None:
        view_features = ViewFeatures(ViewDescriber(Thumbnails(), source), semantics)
    views = [camera], [T_source_camera]
    objective = _Objective(scene.target.gaussians, *views, [shown], options, "auto", view_features)
    T = scene.T_target_source @ motion(2, 0.03, 1.5) @ se3.inverse(T_new_source)
    _, gradient = objective(T)
    direction = gradient / np.linalg.norm(gradient)
    h = 1e-4
    ahead, behind = (objective(T @ se3.exp(s * h * direction))[0] for s in (1.0, -1.0))
    assert (ahead - behind) / (2 * h) == pytest.approx(np.linalg.norm(gradient), rel=0.03)
