"""Views between keyframes, stored compressed until the final refinement has compared them.

Keyframes alone are overfitted: the map reproduces their noise, and views between them are worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe

# Loss of 45 to 55 dB, less than the noise of a sensor.
_JPEG = (
    *(cv2.IMWRITE_JPEG_QUALITY, 98),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)


@dataclass(frozen=True)
class IntermediateView:
    """A tracked frame between two keyframes.

    Attributes:
        index, timestamp_s: of the frame.
        keyframe: frame index of the keyframe before it.
        T_keyframe_camera: [4, 4] float64 pose relative to that keyframe.
        exposure: of the frame against the map.
        camera: intrinsics.
        jpeg: [B] uint8, the colour image as a JPEG file.
        depth_m: [H, W] float16 measured depth, 0 where missing; its error is 0.5 mm at 2 m.
        ignored: [B] uint8, packed bits of the pixels that are not mapped; None if all are.
    """

    index: int
    timestamp_s: float
    keyframe: int
    T_keyframe_camera: NDArray[np.float64]
    exposure: Exposure
    camera: Camera
    jpeg: NDArray[np.uint8]
    depth_m: NDArray[np.float16]
    ignored: NDArray[np.uint8] | None = None

    @classmethod
    def of(
        cls,
        frame: Frame,
        keyframe: int,
        T_keyframe_camera: NDArray[np.float64],
        exposure: Exposure,
    ) -> IntermediateView:
        """Compress a frame; depth that was not measured is left out."""
        levels = np.rint(frame.rgb * 255.0).astype(np.uint8)
        depth_m = frame.depth_m
        if frame.inferred is not None:
            depth_m = np.where(frame.inferred, np.float32(0.0), depth_m)
        return cls(
            frame.index,
            frame.timestamp_s,
            keyframe,
            T_keyframe_camera,
            exposure,
            frame.camera,
            cv2.imencode(".jpg", cv2.cvtColor(levels, cv2.COLOR_RGB2BGR), _JPEG)[1].reshape(-1),
            depth_m.astype(np.float16),
            None if frame.ignored is None else np.packbits(frame.ignored),
        )

    def opened(self, keyframe: Keyframe) -> Keyframe:
        """The view in the form of a keyframe, without labels.

        Args:
            keyframe: the one before it, whose pose and white balance may have changed since.
        """
        transient = None
        if self.ignored is not None:
            shape = self.depth_m.shape
            bits = np.unpackbits(self.ignored, count=shape[0] * shape[1])
            transient = torch.from_numpy(bits.reshape(shape).astype(bool))
        pixels = cv2.cvtColor(cv2.imdecode(self.jpeg, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        return Keyframe(
            self.index,
            self.timestamp_s,
            keyframe.T_map_camera @ self.T_keyframe_camera,
            torch.from_numpy(pixels).permute(2, 0, 1).contiguous(),
            torch.from_numpy(self.depth_m.astype(np.float32)),
            self.camera,
            self.exposure.with_balance(keyframe.exposure.balance),
            np.zeros((0, 3), np.float32),
            transient=transient,
        )

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of a checkpoint."""
        ignored = {} if self.ignored is None else {"ignored": self.ignored}
        return {
            "T_keyframe_camera": self.T_keyframe_camera,
            "jpeg": self.jpeg,
            "depth_m": self.depth_m,
            **ignored,
        }

    def values(self) -> dict[str, Any]:
        """JSON values of a checkpoint."""
        return {
            "index": self.index,
            "timestamp_s": self.timestamp_s,
            "keyframe": self.keyframe,
            "camera": asdict(self.camera),
            "exposure": asdict(self.exposure),
        }

    @classmethod
    def from_state(
        cls, arrays: Mapping[str, NDArray], values: Mapping[str, Any]
    ) -> IntermediateView:
        """Restore a view from its `arrays` and `values`."""
        return cls(
            int(values["index"]),
            float(values["timestamp_s"]),
            int(values["keyframe"]),
            np.array(arrays["T_keyframe_camera"]),
            Exposure.from_values(values["exposure"]),
            Camera(**values["camera"]),
            np.array(arrays["jpeg"]),
            np.array(arrays["depth_m"]),
            np.array(arrays["ignored"]) if "ignored" in arrays else None,
        )
