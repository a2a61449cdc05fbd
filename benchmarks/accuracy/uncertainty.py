"""Reported covariances beside the true errors of frames, on recordings and rooms.

    python -m benchmarks.accuracy.uncertainty

Every first, fourth and eighth frame of each sequence is run without the final refinement, and the
covariance of each frame is compared with its error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.recordings import source_of
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.base.pose_graph.consistency import quantile
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import describe
from toolkit.datasets.shutter.recording import estimate_readout, with_readout
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings
from toolkit.slam.result import SlamResult

Array = NDArray[np.float64]

_CONFIDENCE = 0.95
# Maximum time difference of a frame and its ground truth.
_MAX_DIFFERENCE_S = 1e-4


@dataclass(frozen=True)
class TruthError:
    """Standard deviations of the ground truth itself.

    Attributes:
        metres, degrees: of a pose; a third of the variance is that of each axis.
        seconds: of the time of all poses relative to the images.
    """

    metres: float = 0.0
    degrees: float = 0.0
    seconds: float = 0.0


# The poses of motion capture are late or early by some 10 ms:
# shifted by 5 to 10 ms, those of fr1/rpy agree best with the images (docs/method.md).
_OWN = {
    "redkitchen": TruthError(0.02, 1.0),
    "redkitchen_30fps": TruthError(0.02, 1.0),
    "hololens-small": TruthError(0.02, 1.0),
    "fr1_rpy": TruthError(0.005, 0.35, 0.01),
    "office0": TruthError(0.001, 0.03),
}

TEXT = """\
Each frame's error is that of its pose relative to the first frame with a pose, since the reported
covariances are relative to it: an alignment of the whole path would need the correlations of all
frames. `in ellipse` is the share of the frames whose squared Mahalanobis distance is below the 95 %
quantile of chi-square with six degrees of freedom. The covariance is the reported one plus that of
the ground truth itself, in both frames: 2 cm and 1 degree for RedKitchen and HoloLens, 0.5 cm, 0.35
degrees and the motion in 10 ms for fr1/rpy, 0.1 cm and 0.03 degrees for office0, none for rooms and
the corridor (TartanAir). The readout of the shutter is estimated from the frames that are used, as
in a run; every fourth or eighth frame does not determine it.

`error / sigma` is the median Mahalanobis distance divided by that of a correct model (2.31): above
1 the covariances are too small, below 1 too large. It follows for the position and the rotation
alone. `sigma` is the reported one, without that of the ground truth."""

SEQUENCES = (
    *("redkitchen", "redkitchen_30fps", "fr1_rpy", "hololens-small", "tartanair-corridor"),
    *("office0", "room", "room-noise"),
)
STRIDES = (1, 4, 8)
COLUMNS = (
    *("frames", "lost", "doubtful", "in ellipse %", "error / sigma", "position", "rotation"),
    *("error cm", "error deg", "sigma cm", "sigma deg"),
)
_PARTS = {"error / sigma": slice(0, 6), "position": slice(0, 3), "rotation": slice(3, 6)}
_UNITS = {"cm": (slice(0, 3), 100.0), "deg": (slice(3, 6), 180.0 / np.pi)}


@dataclass(frozen=True)
class Compared:
    """Errors of the frames of a run and their covariances.

    Attributes:
        errors: [N, 6] x in T_world_camera exp(x) = truth, translation first.
        reported: [N, 6, 6]. truth: [N, 6, 6] of the ground truth itself.
    """

    errors: Array
    reported: Array
    truth: Array

    def squared_distances(self, part: slice = slice(0, 6)) -> Array:
        """Squared Mahalanobis distances [N] of the errors or of a part of their components."""
        covariances = (self.reported + self.truth)[:, part, part]
        errors = self.errors[:, part, None]
        return np.asarray((errors * np.linalg.solve(covariances, errors)).sum(axis=(1, 2)))

    def ratio(self, part: slice = slice(0, 6)) -> float:
        """Median distance relative to that of a correct model."""
        size = self.errors[:, part].shape[1]
        return float(np.sqrt(np.median(self.squared_distances(part)) / quantile(0.5, size)))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which errors [N] are within the ellipse."""
        return np.asarray(self.squared_distances() <= quantile(_CONFIDENCE, 6))


def measure(job: tuple[str, int], _seed: int) -> Metrics:
    """Run every n-th frame of a sequence, and compare."""
    name, stride = job
    dataset = strided(name, stride)
    result = run(name, dataset)
    found = compare(result, dataset.recording.ground_truth, _OWN.get(name, TruthError()))
    metrics: Metrics = {
        "frames": len(found.errors),
        "lost": len(result.lost_frames),
        "doubtful": len(result.doubtful_frames),
        "in ellipse %": 100.0 * float(found.inside.mean()),
    }
    metrics |= {title: found.ratio(part) for title, part in _PARTS.items()}
    for unit, (part, scale) in _UNITS.items():
        errors = np.linalg.norm(found.errors[:, part], axis=1)
        sigmas = np.sqrt(np.trace(found.reported[:, part, part], axis1=1, axis2=2))
        metrics[f"error {unit}"] = scale * float(np.median(errors))
        metrics[f"sigma {unit}"] = scale * float(np.median(sigmas))
    return metrics


def table(rows: Rows) -> Table:
    """All rows, and the share within the ellipse over all sequences."""
    found = dict(rows)
    for stride in STRIDES:
        runs = [run for name, (run,) in rows.items() if name.endswith(f", every {stride}")]
        frames = sum(run["frames"] for run in runs)
        inside = sum(run["frames"] * run["in ellipse %"] for run in runs)
        share = inside / frames if frames else None
        found[f"all, every {stride}"] = [{"frames": frames, "in ellipse %": share}]
    return table_of(COLUMNS, found, "sequence, every n-th frame")


def strided(name: str, stride: int) -> RecordedDataset:
    """Every n-th frame of a sequence, as in a run, with the ground truth of all frames."""
    kind, path, size = source_of(name)
    described = describe(kind, path)
    shown = replace(described, files=described.files[::stride])
    if shown.readout_s is None:
        shown = with_readout(shown, estimate_readout(shown))
    return RecordedDataset(shown, size)


def run(name: str, dataset: RecordedDataset) -> SlamResult:
    """Run the system without the final refinement, which does not move poses."""
    values = {"dataset": {"kind": source_of(name).kind}, "mapping": {"final_iterations": 0}}
    settings = validated(RunSettings, values)
    slam = build_slam(dataset, settings)
    for frame in dataset:
        slam.process_frame(frame)
    return slam.finish()


def compare(result: SlamResult, truth: Trajectory | None, own: TruthError) -> Compared:
    """Errors of all frames with ground truth but the first one, and their covariances.

    Args:
        truth: of all frames of the sequence, also of those that were left out.
        own: error of the ground truth.
    """
    assert truth is not None and result.covariances is not None
    times = result.trajectory.timestamps_s
    places = np.array([np.argmin(np.abs(truth.timestamps_s - time)) for time in times])
    known = np.abs(truth.timestamps_s[places] - times) <= _MAX_DIFFERENCE_S
    places = places[known]
    T = result.trajectory.T_world_camera[known]
    T_first = se3.inverse(T[0]) @ T
    true_first = se3.inverse(truth.T_world_camera[places[0]]) @ truth.T_world_camera[places]
    errors = np.array([se3.log(E) for E in se3.inverse(T_first) @ true_first])
    own_covariances = np.array(list(_truth_covariances(truth, places, own)))
    return Compared(errors[1:], result.covariances[known][1:], own_covariances[1:])


def _truth_covariances(
    truth: Trajectory, places: NDArray[np.integer], own: TruthError
) -> Iterator[Array]:
    """Covariance [6, 6] of the ground truth of each frame relative to the first."""
    variances = np.array([own.metres**2] * 3 + [np.radians(own.degrees) ** 2] * 3) / 3.0
    # Rooms have no error; a covariance must be positive.
    pose = np.diag(variances + 1e-12)
    velocities = [_velocity(truth, place) for place in places]
    for place, velocity in zip(places, velocities, strict=True):
        T = se3.inverse(truth.T_world_camera[place]) @ truth.T_world_camera[places[0]]
        A = se3.adjoint(T)
        moved = own.seconds * (velocity - A @ velocities[0])
        yield pose + A @ pose @ A.T + np.outer(moved, moved)


def _velocity(truth: Trajectory, place: int) -> Array:
    """Velocity [6] (m/s, rad/s) of the camera in its own frame."""
    a, b = max(place - 1, 0), min(place + 1, len(truth) - 1)
    elapsed_s = truth.timestamps_s[b] - truth.timestamps_s[a]
    step = se3.inverse(truth.T_world_camera[a]) @ truth.T_world_camera[b]
    return np.asarray(se3.log(step) / elapsed_s)


PAGE = Page(
    "uncertainty",
    "Reported covariances",
    TEXT,
    {f"{name}, every {stride}": (name, stride) for stride in STRIDES for name in SEQUENCES},
    measure,
    lambda rows: [table(rows)],
)

if __name__ == "__main__":
    PAGE.main()
