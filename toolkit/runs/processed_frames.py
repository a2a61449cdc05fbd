"""What identifies the frames that a run has processed, so that it is resumed with the same ones."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from toolkit.base.errors import RunFolderError
from toolkit.datasets.base import RecordedDataset

# Identity of frames by what it describes: its words for messages.
Identity = dict[str, str]


def identity_of(dataset: RecordedDataset, frames: int, given_poses: bool) -> Identity:
    """Identify the first frames of a recording.

    The content of the images is not compared: reading them again would take as long as the run.
    Later frames may change, so that damaged ones can be replaced before the run is resumed.

    Args:
        frames: number of frames from the start, up to the length of the dataset.
        given_poses: whether the run takes its poses from the dataset.
    """
    recording = dataset.recording
    files = recording.files[:frames]
    entries = [(f.name, f.timestamp_s, f.depth is None, f.labels is None) for f in files]
    found = {
        "the camera": repr((recording.camera, recording.distortion, recording.fisheye)),
        "the depth scale": repr(recording.depth_scale),
        "what moves with the camera in the images": repr(
            None if recording.carrier is None else _digest(recording.carrier.tobytes())
        ),
        "the names or times of the first frames": _digest(repr(entries).encode()),
    }
    truth = dataset.ground_truth
    if given_poses and truth is not None and files:
        seen = truth.timestamps_s <= files[-1].timestamp_s
        poses = np.ascontiguousarray(truth.T_world_camera[seen])
        found["the poses of the first frames"] = _digest(poses.tobytes())
    return found


def check_identity(saved: Mapping[str, str], now: Identity, path: object) -> None:
    """Check that a run continues with the frames that it has processed.

    Args:
        saved: identity in its checkpoint; empty if none was saved.
        path: of the run folder, for the message.

    Raises:
        RunFolderError: the dataset was changed.
    """
    for what, value in saved.items():
        if now.get(what) != value:
            raise RunFolderError(
                f"cannot resume {path}: {what} of the dataset changed after its checkpoint; "
                "restore the dataset, or start a new run"
            )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
