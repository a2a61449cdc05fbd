"""A few frames of a synthetic room on disk, as a dataset of kind `folder` with labels."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS
from toolkit.io import images
from toolkit.io.trajectories import write_tum

FRAMES, WIDTH, HEIGHT = 6, 64, 48
_FPS, _DEPTH_SCALE = 30.0, 5000.0


def write_tiny_recording(folder: Path) -> Path:
    """Write the recording into a new folder and return the folder."""
    frames, truth = tiny_room(FRAMES, WIDTH, HEIGHT)
    for name in ("rgb", "depth", "labels"):
        (folder / name).mkdir(parents=True)
    for frame in frames:
        stem = f"{frame.index:04d}.png"
        images.write_rgb(folder / "rgb" / stem, frame.rgb)
        images.write_depth_png(folder / "depth" / stem, frame.depth_m, _DEPTH_SCALE)
        assert frame.labels is not None
        images.write_png(folder / "labels" / stem, frame.labels.astype("uint8"))
    camera = frames[0].camera
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    intrinsics |= {"width": WIDTH, "height": HEIGHT, "depth_scale": _DEPTH_SCALE, "fps": _FPS}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(intrinsics))
    classes = {str(number): name for name, number in CLASS_IDS.items()}
    names = json.dumps({"void": 0, "classes": classes})
    (folder / "labels" / "classes.json").write_text(names)
    write_tum(folder / "trajectory.txt", truth)
    return folder
