"""Feed RGB-D images to SLAM one by one, as a live camera would deliver them.

    python apps/02_camera_loop.py map.ply

A driver delivers 8-bit colour, 16-bit depth in millimetres and a timestamp. Here a small synthetic
room takes the place of the driver: replace `camera_images` by your own.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

import toolkit
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.tools.cli.errors import one_line_errors


@dataclass(frozen=True)
class CameraImage:
    """One image of the driver. Depth is registered to colour and 0 where it is missing."""

    timestamp_s: float
    rgb: np.ndarray  # [H, W, 3] uint8
    depth_mm: np.ndarray  # [H, W] uint16
    camera: toolkit.Camera


def camera_images(count: int, width: int, height: int) -> Iterator[CameraImage]:
    """Images of a synthetic room in place of those of a driver."""
    frames, _ = tiny_room(count, width, height)
    for frame in frames:
        rgb = np.rint(255.0 * frame.rgb).astype(np.uint8)
        depth_mm = np.rint(1000.0 * frame.depth_m).clip(0, 65535).astype(np.uint16)
        yield CameraImage(frame.timestamp_s, rgb, depth_mm, frame.camera)


def main(out: Path, count: int = 20, width: int = 160, height: int = 120) -> int:
    """Track and map until the images end; write the map and the trajectory beside it."""
    slam = toolkit.build_slam()
    for index, image in enumerate(camera_images(count, width, height)):
        colour = image.rgb.astype(np.float32) / 255.0
        depth_m = image.depth_mm.astype(np.float32) / 1000.0
        frame = toolkit.Frame(index, image.timestamp_s, colour, depth_m, image.camera)
        found = slam.process_frame(frame)
        if found.T_world_camera is None:
            print(f"frame {index}: lost; move the camera back to a mapped place")
        else:
            x, y, z = found.T_world_camera[:3, 3]
            print(f"frame {index}: camera at ({x:.3f}, {y:.3f}, {z:.3f}) m")
    result = slam.finish()

    write_splat_ply(out, result.gaussians)
    write_tum(out.with_suffix(".txt"), result.trajectory)
    print(f"wrote {out} and {out.with_suffix('.txt')} ({result.trajectory})")
    return 0


if __name__ == "__main__":
    if len(sys.argv) not in (2, 5):
        sys.exit("usage: python apps/02_camera_loop.py MAP.ply [FRAMES WIDTH HEIGHT]")
    sys.exit(one_line_errors(lambda: main(Path(sys.argv[1]), *map(int, sys.argv[2:]))))
