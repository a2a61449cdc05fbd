"""Accuracy and consistency of the geometric segmenter on labelled sequences, poses given.

SEMSPLAT_DATA=DATA python -m benchmarks.segmenters
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.io.images import write_png
from toolkit.io.visualisation import Panel, colour_image, strip
from toolkit.semantics.segmenters.geometric import CLASS_NAMES, GeometricSegmenter

FLOOR, WALL, CEILING, SURFACE, OBJECT = 1, 2, 3, 4, 5
NAMES: dict[int, str] = {
    FLOOR: "floor rug mat",
    CEILING: "ceiling",
    WALL: "wall door window blinds curtain picture panel pillar wall-plug switch clock vent logo "
    "beam",
    SURFACE: "bed bench base-cabinet blanket comforter countertop desk nightstand shelf sofa "
    "stool chair table tv-stand cabinet stair",
}
LEVEL = np.cos(np.radians(25.0))
COLOURS = np.array(
    [[0, 0, 0], [150, 110, 60], [120, 170, 220], [240, 240, 200], [80, 200, 90], [220, 70, 70]],
    np.uint8,
)


DESCRIPTION = """\
The segmenter labels floor, wall, ceiling, level surfaces and objects from depth. The ground truth
comes from the names of the classes: floor, ceiling and wall by name; what hangs flat on a wall
(doors, windows, pictures, ...) is wall, because depth cannot distinguish it; surface is the parts
of tables, beds, seats, shelves and the like whose true normal, from noise-free depth, is within 25
degrees of up; everything else is an object. "Structure" is the accuracy with surface and object as
one class. "Consistency" is the share of pixels whose class is the same in the previous frame,
warped by the true poses where depths agree within 2 %: the mean and the worst pair of frames. Void
is excluded. Percent."""


@dataclass(frozen=True)
class Options:
    """Evaluate the geometric segmenter."""

    every: int = 1
    """Use every n-th frame."""
    no_poses: bool = False
    """Withhold the poses, so that every frame is labelled by itself."""
    pictures: Path | None = None
    """Folder for pictures of some frames."""
    out: Path = RESULTS
    """Folder of the results file."""


class Sequence(NamedTuple):
    """A data set, and the one that holds its true depth and labels, if there is one."""

    data: RecordedDataset
    truth: RecordedDataset | None


@dataclass
class Score:
    """What is counted over a sequence; `confusion` is [true, found]."""

    confusion: NDArray[np.int64] = field(default_factory=lambda: np.zeros((6, 6), np.int64))
    consistency: list[float] = field(default_factory=list)


def main() -> None:
    """Measure one row for each sequence."""
    options = tyro.cli(Options)
    header = current_header((), ("toolkit/semantics/segmenters",))
    names = list(CLASS_NAMES.values())
    columns = ["sequence", "accuracy", "structure", "mIoU", *(f"IoU {n}" for n in names)]
    rows = [
        (name, *_cells(_score(name, sequence, options))) for name, sequence in _sequences().items()
    ]
    table = Table((*columns, "consistency", "worst"), tuple(rows))
    results = Results("segmenter", "Geometric segmenter", DESCRIPTION, header, (table,))
    if options.every == 1 and not options.no_poses:
        publish(results, options.out)
    else:
        print(results.markdown())


def _sequences() -> dict[str, Sequence]:
    def recording(name: str) -> RecordedDataset:
        found = RECORDINGS[name]
        return open_dataset(found.kind, found.path, found.image_size)

    office, ideal = recording("office0"), open_dataset("synthetic", room("room"))
    noisy = open_dataset("synthetic", room("room-noise"))
    return {
        "office0": Sequence(office, office),
        "redkitchen": Sequence(recording("redkitchen"), None),
        "fr1_rpy": Sequence(recording("fr1_rpy"), None),
        "room": Sequence(ideal, ideal),
        "room, sensor noise": Sequence(noisy, ideal),
    }


def _score(name: str, sequence: Sequence, options: Options) -> Score:
    """Label a sequence and count."""
    segmenter, score = GeometricSegmenter(), Score()
    up = _true_up(sequence.truth) if sequence.truth else None
    before: tuple[Frame, NDArray[np.int32], NDArray[np.float64]] | None = None
    first: NDArray[np.float64] | None = None
    shown = 0
    for index, T_world_camera in _posed(sequence.data)[:: options.every]:
        frame = sequence.data[index]
        first = T_world_camera if first is None else first
        pose = None if options.no_poses else se3.inverse(first) @ T_world_camera
        labels = segmenter.segment(frame, pose)
        true = None
        if sequence.truth is not None and up is not None:
            true = _true_labels(sequence.truth, index, up @ T_world_camera[:3, :3])
            counted = (true > 0) & (frame.depth_m > 0)
            pairs = 6 * true[counted] + labels[counted]
            score.confusion += np.bincount(pairs, minlength=36).reshape(6, 6)
        if before is not None:
            score.consistency.append(_agreement(before, (frame, labels, T_world_camera)))
        before = frame, labels, T_world_camera
        if options.pictures and index >= shown:
            shown = index + max(1, len(sequence.data) // 12)
            _draw(options.pictures / f"{name}_{index:06d}.png", frame, labels, true)
    return score


def _posed(dataset: RecordedDataset) -> list[tuple[int, NDArray[np.float64]]]:
    """Frames that have a true pose, and the pose."""
    truth = dataset.ground_truth
    assert truth is not None
    poses = dict(zip(truth.timestamps_s.tolist(), truth.T_world_camera, strict=True))
    times = dataset.timestamps_s.tolist()
    return [(index, poses[time]) for index, time in enumerate(times) if time in poses]


def _class_table(dataset: RecordedDataset) -> NDArray[np.int64]:
    """Our class by the data set's class id."""
    assert dataset.label_names is not None
    table = np.full(max(dataset.label_names) + 1, OBJECT)
    table[0] = 0
    for number, name in dataset.label_names.items():
        for ours, names in NAMES.items():
            if name in names.split():
                table[number] = ours
    return table


def _true_up(dataset: RecordedDataset) -> NDArray[np.float64]:
    """Up in the world: the normal of the plane through what is labelled floor."""
    table, parts, cameras = _class_table(dataset), [], []
    for index, T_world_camera in _posed(dataset)[:: max(1, len(dataset) // 20)]:
        frame = dataset[index]
        assert frame.labels is not None
        floor = (table[frame.labels] == FLOOR) & (frame.depth_m > 0)
        points = frame.camera.unproject(frame.depth_m)[floor][::17]
        parts.append(se3.transform_points(T_world_camera, points))
        cameras.append(-T_world_camera[:3, 1])
    points = np.concatenate(parts)
    points -= np.median(points, axis=0)
    for _ in range(3):
        up = np.linalg.eigh(points.T @ points)[1][:, 0]
        points = points[np.abs(points @ up) < 0.05]
    return np.asarray(up * np.sign(up @ np.sum(cameras, axis=0)))


def _true_labels(
    dataset: RecordedDataset, index: int, up_camera: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Our classes [H, W] of a frame, from its labels and the normals of its depth."""
    frame = dataset[index]
    assert frame.labels is not None
    labels = _class_table(dataset)[frame.labels]
    points = frame.camera.unproject(frame.depth_m)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    labels[(labels == SURFACE) & (normals @ up_camera < LEVEL)] = OBJECT
    labels[frame.depth_m == 0] = 0
    return labels


def _agreement(
    before: tuple[Frame, NDArray[np.int32], NDArray[np.float64]],
    now: tuple[Frame, NDArray[np.int32], NDArray[np.float64]],
) -> float:
    """Share of pixels whose class is that of the pixel of the frame before that saw them."""
    (frame_0, labels_0, T_0), (frame_1, labels_1, T_1) = before, now
    points = se3.transform_points(se3.inverse(T_0) @ T_1, frame_1.camera.unproject(frame_1.depth_m))
    known = (frame_1.depth_m > 0) & (points[..., 2] > 0.1) & (labels_1 > 0)
    pixels = np.rint(frame_0.camera.project(points[known])).astype(int)
    inside = ((pixels >= 0) & (pixels < frame_0.camera.size)).all(axis=1)
    x, y = pixels[inside].T
    depth, found = points[known][inside][:, 2], labels_1[known][inside]
    same_place = np.abs(frame_0.depth_m[y, x] - depth) < 0.02 * depth
    same_place &= labels_0[y, x] > 0
    agrees = labels_0[y, x][same_place] == found[same_place]
    return float(agrees.mean()) if len(agrees) else float("nan")


def _cells(score: Score) -> list[str]:
    consistency = [np.nanmean(score.consistency), np.nanmin(score.consistency)]
    values = [float("nan")] * 8
    confusion = score.confusion[1:]
    if confusion.any():
        right = np.diag(score.confusion)[1:]
        merged = right.sum() + confusion[3, 5] + confusion[4, 4]
        union = confusion.sum(axis=1) + confusion.sum(axis=0)[1:] - right
        ious = right / np.maximum(union, 1)
        values = [right.sum() / confusion.sum(), merged / confusion.sum(), ious.mean(), *ious]
    return ["n/a" if np.isnan(v) else f"{100 * v:.1f}" for v in [*values, *consistency]]


def _draw(
    path: Path, frame: Frame, labels: NDArray[np.int32], true: NDArray[np.int64] | None
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    panels = [Panel("frame", colour_image(frame.rgb)), Panel("found", COLOURS[labels])]
    if true is not None:
        panels.append(Panel("true", COLOURS[true]))
    write_png(path, strip(panels))


if __name__ == "__main__":
    main()
