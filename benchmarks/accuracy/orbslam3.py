"""ORB-SLAM3 with depth, as the package orbslam3-python.

It comes without a vocabulary of ORB descriptors, in DBoW2's text format, so that one is trained
from images of the sequences.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.recordings import opened
from benchmarks.shared.runner import WORK
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.alignment.levels import intensity_of

Grey = NDArray[np.uint8]
Pose = NDArray[np.floating]
Bits = NDArray[np.float32]

# ORB-SLAM3 maps in a thread of its own while the next images are tracked. It is given images at
# this interval, which is several times what it needs for one on the slowest machine.
_INTERVAL_S = 0.15
_TRACKED, _RECENTLY_LOST = "OK", "RECENTLY_LOST"
_ORB_FEATURES = 1000
_VOCABULARY_IMAGES = 40
_VOCABULARY_SEQUENCES = (
    *("office0", "euroc", "room", "room-noise", "redkitchen", "hololens", "hololens-small"),
    *("walk", "walk-fast", "phone", "fr1_rpy"),
)
# Children of a node and levels, as in ORB-SLAM3's own vocabulary, whose matching depends on them.
_BRANCHES, _LEVELS = 10, 6
# A node with fewer descriptors is a word.
_MIN_SPLIT = 20
_ITERATIONS = 8
_FEATURES = 800
# L1 distances of word histograms that are weighted by TF-IDF.
_SCORING, _WEIGHTING = 0, 0


def grey(frame: Frame) -> Grey:
    """The grey image [H, W] that the method is given."""
    return np.round(255.0 * intensity_of(frame.rgb).numpy()).clip(0, 255).astype(np.uint8)


def tracked_by_orbslam3(
    frames: Iterable[Frame], camera: Camera, folder: Path
) -> tuple[list[set[float]], list[tuple[float, Pose]]]:
    """Timestamps of the tracked frames of each map, and final poses T_camera_world.

    The package returns the poses of only those frames whose keyframe is still in a map.

    Args:
        folder: for files.
    """
    import orbslam3

    settings = folder / "orbslam3.yaml"
    settings.write_text(_settings(camera), encoding="ascii")
    system = orbslam3.System(str(vocabulary()), str(settings), orbslam3.Sensor.RGBD)
    system.set_use_viewer(False)
    system.initialize()
    maps: list[set[float]] = [set()]
    for frame in frames:
        begin = time.perf_counter()
        system.process_image_rgbd(grey(frame), frame.depth_m, frame.timestamp_s)
        state = str(system.get_tracking_state())
        if state == _TRACKED:
            maps[-1].add(frame.timestamp_s)
        elif state != _RECENTLY_LOST:
            maps.append(set())
        time.sleep(max(0.0, _INTERVAL_S - (time.perf_counter() - begin)))
    poses = list(system.get_trajectory_points())
    system.shutdown()
    return maps, poses


def vocabulary() -> Path:
    """The words of ORB-SLAM3, which are trained when they are first needed."""
    path = WORK / "orb_vocabulary.txt"
    if not path.exists():
        print("training a vocabulary", flush=True)
        write_vocabulary(path, _training_images())
    return path


def _training_images() -> Iterator[Grey]:
    for sequence in _VOCABULARY_SEQUENCES:
        dataset = opened(sequence)
        chosen = np.linspace(0, len(dataset) - 1, _VOCABULARY_IMAGES).astype(int)
        for index in np.unique(chosen):
            yield grey(dataset[int(index)])


def _settings(camera: Camera) -> str:
    """The settings file: the values of its examples, but for the camera.

    Points closer than 40 baselines are near ones; the baseline is that of Kinect's projector.
    """
    values = {
        **{f"Camera1.{name}": getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        **{f"Camera1.{name}": 0.0 for name in ("k1", "k2", "p1", "p2")},
        "Camera.width": camera.width,
        "Camera.height": camera.height,
        "Camera.fps": 30,
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": _ORB_FEATURES,
        "ORBextractor.scaleFactor": 1.2,
        "ORBextractor.nLevels": 8,
        "ORBextractor.iniThFAST": 20,
        "ORBextractor.minThFAST": 7,
        "Stereo.b": 0.075,
        "Stereo.ThDepth": 40.0,
        "RGBD.DepthMapFactor": 1.0,
        # Required, although there is no viewer.
        "Viewer.KeyFrameSize": 0.05,
        "Viewer.KeyFrameLineWidth": 1.0,
        "Viewer.GraphLineWidth": 0.9,
        "Viewer.PointSize": 2.0,
        "Viewer.CameraSize": 0.08,
        "Viewer.CameraLineWidth": 3.0,
        "Viewer.ViewpointX": 0.0,
        "Viewer.ViewpointY": -0.7,
        "Viewer.ViewpointZ": -1.8,
        "Viewer.ViewpointF": 500.0,
    }
    head = '%YAML:1.0\nFile.version: "1.0"\nCamera.type: "PinHole"\n'
    return head + "".join(f"{name}: {value}\n" for name, value in values.items())


@dataclass
class _Tree:
    """Lines of the file: parent, whether it is a word, descriptor, weight."""

    images: int
    nodes: list[tuple[int, bool, NDArray[np.uint8], float]] = field(default_factory=list)

    def split(self, parent: int, level: int, bits: Bits, image: NDArray[np.int64]) -> None:
        """Add the descriptors below a node; 0 is the root."""
        centres, member = _clusters(bits)
        for number, centre in enumerate(centres):
            own = member == number
            word = level == _LEVELS or int(own.sum()) < _MIN_SPLIT
            weight = np.log(self.images / len(np.unique(image[own]))) if word else 0.0
            self.nodes.append((parent, word, np.packbits(centre > 0.5), float(weight)))
            if not word:
                self.split(len(self.nodes), level + 1, bits[own], image[own])


def write_vocabulary(path: Path, images: Iterable[NDArray[np.uint8]]) -> None:
    """Train a vocabulary on grey images [H, W]."""
    orb = cv2.ORB_create(_FEATURES)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    found = [descriptors for descriptors in found if descriptors is not None]
    image = np.repeat(np.arange(len(found)), [len(descriptors) for descriptors in found])
    tree = _Tree(len(found))
    tree.split(0, 1, np.unpackbits(np.concatenate(found), axis=1).astype(np.float32), image)
    lines = [f"{_BRANCHES} {_LEVELS} {_SCORING} {_WEIGHTING}"]
    for parent, word, descriptor, weight in tree.nodes:
        lines.append(f"{parent} {int(word)} {' '.join(map(str, descriptor))} {weight:.6g}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _clusters(bits: Bits) -> tuple[Bits, NDArray[np.int64]]:
    """K-majority: centres [K, 256] without empty ones, and the centre of each descriptor."""
    rng = np.random.default_rng(0)
    unique = np.unique(bits, axis=0) if len(bits) < 10_000 else bits
    centres = rng.permutation(unique)[:_BRANCHES]
    member = np.zeros(len(bits), np.int64)
    for _ in range(_ITERATIONS):
        # Hamming distance, apart from the number of bits of the descriptor itself.
        distance = centres.sum(1) - 2.0 * bits @ centres.T
        member = distance.argmin(1)
        used = np.unique(member)
        member = np.searchsorted(used, member)
        centres = np.stack([bits[member == n].mean(0) > 0.5 for n in range(len(used))])
        centres = centres.astype(np.float32)
    return centres, member
