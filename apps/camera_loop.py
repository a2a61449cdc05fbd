"""Worked example: push RGB-D images into SLAM one by one, as a live camera would.

    python apps/camera_loop.py map.ply
    python apps/camera_loop.py map.ply tum ~/data/rgbd_dataset_freiburg1_desk

A driver hands over 8-bit colour, 16-bit depth in millimetres and a time. Here a small
synthetic room, or the recording that is named, stands in for the driver: replace
`images_of_a_camera` and `CameraImage` by your own.
"""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from toolkit.baselines.factory import build_tracker
from toolkit.cli.errors import one_line_errors
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic import tiny_room
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.mapping.factory import build_mapper
from toolkit.settings.mapping import MappingSettings
from toolkit.slam import Slam
from toolkit.tracking.options import TrackingOptions
from toolkit.tracking.placement import KeyframePlacement


@dataclass(frozen=True)
class CameraImage:
    """What a driver delivers: depth is registered to colour, 0 where missing."""

    timestamp_s: float
    rgb: np.ndarray  # [H, W, 3] uint8
    depth_mm: np.ndarray  # [H, W] uint16


def images_of_a_camera(frames: Iterable[Frame]) -> Iterator[CameraImage]:
    """Stands in for a driver's loop."""
    for frame in frames:
        rgb = np.rint(255.0 * frame.rgb).astype(np.uint8)
        depth_mm = np.rint(1000.0 * frame.depth_m).clip(0, 65535).astype(np.uint16)
        yield CameraImage(frame.timestamp_s, rgb, depth_mm)


def as_frame(index: int, image: CameraImage, camera: Camera) -> Frame:
    """The toolkit's own units: colour in [0, 1], depth in metres, both float32."""
    return Frame(
        index=index,
        timestamp_s=image.timestamp_s,
        rgb=image.rgb.astype(np.float32) / 255.0,
        depth_m=image.depth_mm.astype(np.float32) / 1000.0,
        camera=camera,
    )


def main(out: Path, images: Iterable[CameraImage], camera: Camera) -> int:
    """Track and map until the images end; leave a splat file and the path beside it."""
    mapper = build_mapper(MappingSettings(), np.random.default_rng(0))
    slam = Slam(build_tracker(TrackingOptions()), mapper, placement=KeyframePlacement())

    for index, image in enumerate(images):
        result = slam.process_frame(as_frame(index, image, camera))
        if result.T_world_camera is None:
            print(f"frame {index}: lost; go back to where the camera has been")
        else:
            x, y, z = result.T_world_camera[:3, 3]
            print(f"frame {index}: at ({x:.3f}, {y:.3f}, {z:.3f}) m, {slam.mapper.gaussians}")
    final = slam.finish()

    write_splat_ply(out, final.gaussians)
    write_tum(out.with_suffix(".txt"), final.trajectory)
    print(f"wrote {out} and {out.with_suffix('.txt')} ({final.trajectory})")
    return 0


def run(words: list[str]) -> int:
    """Open the source that the command line names."""
    if len(words) == 1:
        frames, _ = tiny_room(frames=20, width=160, height=120)
        return main(Path(words[0]), images_of_a_camera(frames), frames[0].camera)
    recording = open_dataset(words[1], words[2])
    frames_ahead = prefetched(recording, range(len(recording)))
    return main(Path(words[0]), images_of_a_camera(frames_ahead), recording.camera)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 4):
        sys.exit("usage: python apps/camera_loop.py MAP.ply [KIND FOLDER]")
    sys.exit(one_line_errors(lambda: run(sys.argv[1:])))
