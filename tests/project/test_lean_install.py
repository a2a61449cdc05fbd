"""A GPU server often has torch, numpy and OpenCV, and little else of what a run needs."""

# Draws, tracks and maps three small frames where the other libraries cannot be imported.
RUN_STAGES = """
import sys
for name in (
    *("open3d", "gtsam", "faiss", "pydantic", "tyro", "rich", "transformers", "triton"),
    *("yaml", "scipy", "sklearn", "tqdm", "matplotlib"),
):
    sys.modules[name] = None  # an import of it now fails
import numpy as np
import torch
from toolkit.base.keyframe import Keyframe
from toolkit.base.frame import Frame
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.rendering import render
from toolkit.slam.tracking.dense import DenseTracker

camera = Camera(40.0, 40.0, 23.5, 17.5, 48, 36)
v, u = np.mgrid[-8.0:44.0:0.5, -8.0:56.0:0.5].reshape(2, -1)
z = 2.0 + 0.3 * np.sin(0.2 * u) + 0.2 * np.cos(0.25 * v)
points = np.stack([(u - camera.cx) / 40.0 * z, (v - camera.cy) / 40.0 * z, z], axis=1)
tone = 0.5 + 0.4 * np.sin(0.5 * u) * np.cos(0.4 * v)
room = GaussianCloud.from_values(
    torch.from_numpy(points).float(),
    torch.from_numpy(0.7 * z / 40.0).float(),
    torch.full((len(z),), 0.9),
    torch.from_numpy(np.stack([tone] * 3, axis=1)).float(),
)
tracker = DenseTracker(levels=2)
mapper = Mapper(MapperOptions(first_iterations=3, iterations=2))
submap = mapper.first_submap()
for index in range(3):
    truth = se3.exp(np.array([0.01, -0.005, 0.004, 0.002, -0.003, 0.001]) * index)
    view = render(room, camera, se3.inverse(truth))
    rgb = view.colour.clamp(0.0, 1.0).contiguous().numpy()
    frame = Frame(index, index / 30.0, rgb, view.depth_m.contiguous().numpy(), camera=camera)
    if index == 0:
        found = tracker.first_pose(frame)
    else:
        found = tracker.track(frame, submap.gaussians).T_map_camera
    mapper.add_keyframe(submap, Keyframe.from_frame(frame, found))
    print(1000.0 * np.linalg.norm((found - truth)[:3, 3]))
"""


def test_rendering_tracking_and_mapping_run_with_torch_alone(run_python):
    result = run_python("-c", RUN_STAGES, OMP_NUM_THREADS="1")
    assert result.returncode == 0, result.stderr
    errors_mm = [float(line) for line in result.stdout.split()]
    assert len(errors_mm) == 3
    assert max(errors_mm) < 5.0
