"""What a run estimates of a recording while it opens it, so that it need not be estimated again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Recording


@dataclass(frozen=True)
class RecordingEstimates:
    """Values of a recording that may be estimated from its images; see `Recording`.

    Attributes:
        camera: intrinsics of the image files.
        distortion: distortion of the images, or None.
        depth_offset_px: (x, y) by which colour images are offset from depth images.
        readout_s: readout of an image in seconds; None if it was not determined.
        readout_sigma_s: its standard deviation.
    """

    camera: Camera
    distortion: tuple[float, ...] | None
    depth_offset_px: tuple[float, float]
    readout_s: float | None
    readout_sigma_s: float

    @classmethod
    def of(cls, recording: Recording) -> RecordingEstimates:
        """The values of a recording that was opened."""
        return cls(
            recording.camera,
            recording.distortion,
            recording.depth_offset_px,
            recording.readout_s,
            recording.readout_sigma_s,
        )

    def fit(self, recording: Recording) -> bool:
        """Whether the values are for images of the size of a recording."""
        return self.camera.size == recording.camera.size

    def with_readout(self, recording: Recording) -> Recording:
        """Return a recording with the readout."""
        return replace(recording, readout_s=self.readout_s, readout_sigma_s=self.readout_sigma_s)

    def to_json(self) -> dict[str, Any]:
        """Return JSON values from which `from_json` restores the same numbers."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RecordingEstimates:
        """Restore values.

        Raises:
            KeyError, TypeError, ValueError: a value is missing or of another type.
        """
        distortion, readout_s = values["distortion"], values["readout_s"]
        x_px, y_px = map(float, values["depth_offset_px"])
        return cls(
            Camera(**values["camera"]),
            None if distortion is None else tuple(map(float, distortion)),
            (x_px, y_px),
            None if readout_s is None else float(readout_s),
            float(values["readout_sigma_s"]),
        )
