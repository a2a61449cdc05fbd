"""Where the time goes on a GPU: kernels by their total time, as torch's profiler saw them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.gpu.frames import TAXONOMY
from benchmarks.gpu.render import OurContest
from benchmarks.gpu.report import Plan, row, table
from benchmarks.gpu.scene import camera_of, pose_of, surface_cloud, walk
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.codes import one_hot_code
from toolkit.semantics.options import SemanticLossWeights
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.options import DenseOptions
from toolkit.splatting.losses.semantic import SemanticLoss
from toolkit.splatting.rendering import backend

_SHOWN = 15


def profile_table(plan: Plan) -> None:
    """A view forward and backward, a tracked frame, and ten mapping steps."""
    if not plan.timed:
        print("\nThe interpreter has no kernels to profile.")
        return
    camera = camera_of(*plan.size)
    cloud = surface_cloud(camera, plan.counts[0], plan.channels[0] - 4).to(plan.device)
    contest = OurContest(backend("cuda"), cloud, camera)

    def view() -> None:
        contest.forward()
        contest.backward()

    _profiled(f"One view of {plan.counts[0]} Gaussians, {plan.channels[0]} channels", view)
    frames = walk(backend("cuda"), camera, 3, plan.device, len(TAXONOMY))
    semantics = SemanticMapping(SemanticLoss(one_hot_code(TAXONOMY), SemanticLossWeights()))
    mapper = Mapper(MapperOptions(), None, "cuda", None, semantics, plan.device)
    tracker = DenseTracker(DenseOptions(), backend_name="cuda")
    tracker.first_pose(frames[0])
    submap = mapper.first_submap()
    mapper.add_keyframe(submap, Keyframe.from_frame(frames[0], np.eye(4)))
    _profiled("One tracked frame", lambda: tracker.track(frames[1], submap.gaussians))
    mapper.add_keyframe(submap, Keyframe.from_frame(frames[1], pose_of(1)))
    longer = Mapper(MapperOptions(iterations=10), None, "cuda", None, semantics, plan.device)
    _profiled(
        "A keyframe of ten steps",
        lambda: longer.add_keyframe(submap, Keyframe.from_frame(frames[2], pose_of(2))),
    )


def _profiled(title: str, step: Callable[[], object]) -> None:
    """The kernels of a step that has run before, so that nothing is compiled."""
    if title.startswith("One"):
        step()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
        step()
        torch.cuda.synchronize()
    # The operators that launched these kernels are listed with the same times.
    events = [e for e in found.key_averages() if e.device_type.name == "CUDA"]
    total = sum(e.self_device_time_total for e in events) / 1e3
    launches = sum(e.count for e in events)
    title = f"{title}: {launches} launches, {total:.3g} ms on the GPU"
    table(title, "kernel", "calls", "ms together")
    for event in sorted(events, key=lambda e: -e.self_device_time_total)[:_SHOWN]:
        row(event.key[:60].replace("|", " "), event.count, event.self_device_time_total / 1e3)
