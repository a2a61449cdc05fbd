"""RealSense depth cameras, through pyrealsense2."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import CameraError, DependencyError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.runs.live.camera import CapturedFrame

if TYPE_CHECKING:
    from toolkit.datasets.base import RecordedDataset

_SIZE = (640, 480)
_FPS = 30
_WAIT_MS = 100
# Ages of a frame by the clock of the system beyond this one come from clocks that disagree.
_MAX_AGE_S = 1.0


def realsense() -> Any:
    """Import pyrealsense2.

    Raises:
        DependencyError: it is not installed.
    """
    try:
        import pyrealsense2
    except ImportError as error:
        raise DependencyError(
            "--camera realsense needs pyrealsense2: pip install 'semsplat[realsense]'"
        ) from error
    return pyrealsense2


class FrameSets(Protocol):
    """What delivers pairs of depth and colour images: a pipeline, or a test's software device."""

    def start(self) -> None:
        """Start the streams; errors are RuntimeErrors of the library."""

    def wait(self, timeout_ms: int) -> Any | None:
        """The next `rs.composite_frame`, None after the timeout."""

    def stop(self) -> None:
        """Stop the streams."""


class RealSenseCamera:
    """Colour and depth of a RealSense camera; depth is aligned to the colour image.

    Colour images with lens distortion are undistorted, and depth with them.

    Args:
        fps: frames per second of both streams; 30 by default.
        serial: serial number of the camera; by default, the first one found.
        source: replaces the pipeline of the camera.

    Raises:
        DependencyError: pyrealsense2 is missing.
    """

    def __init__(
        self, fps: float | None = None, serial: str | None = None, source: FrameSets | None = None
    ) -> None:
        self._rs = realsense()
        self.name = "realsense" if serial is None else f"realsense {serial}"
        self.depth_scale = 1000.0
        self.dataset: RecordedDataset | None = None
        self._source = source or _Pipeline(self._rs, round(fps or _FPS), serial)
        self._align = self._rs.align(self._rs.stream.color)
        self._stopped = threading.Event()
        self._started = False
        self._camera: Camera | None = None
        self._maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        self._first: Any = None

    def start(self) -> Camera:
        """Start the streams and wait for the first pair of images, which has the intrinsics.

        Raises:
            CameraError: there is no camera, it is busy, or it sends no images.
        """
        try:
            self._source.start()
        except RuntimeError as error:
            raise CameraError(
                f"cannot start the RealSense camera ({error}); connect it to a USB 3 port, close "
                "other programs that use it, or select it by --serial"
            ) from error
        self._started = True
        deadline_s = time.monotonic() + 10.0
        while self._first is None:
            self._first = self._next_pair()
            if time.monotonic() > deadline_s:
                raise CameraError("the RealSense camera sends no images; connect it again")
        profile = self._first.get_color_frame().profile.as_video_stream_profile()
        intrinsics = profile.get_intrinsics()
        self._camera = Camera(
            intrinsics.fx,
            intrinsics.fy,
            intrinsics.ppx,
            intrinsics.ppy,
            intrinsics.width,
            intrinsics.height,
        )
        if any(intrinsics.coeffs):
            self._maps = _undistortion_maps(self._rs, intrinsics)
        self.depth_scale = 1.0 / self._first.get_depth_frame().get_units()
        return self._camera

    def frames(self) -> Iterator[CapturedFrame]:
        """Yield pairs of images until the camera is stopped.

        Raises:
            CameraError: the driver reports an error.
        """
        index, last_s = 0, -float("inf")
        while not self._stopped.is_set():
            try:
                pair, self._first = self._first or self._next_pair(), None
            except RuntimeError as error:
                if self._stopped.is_set():
                    return
                raise CameraError(f"the RealSense camera failed: {error}") from error
            # A camera that was reset repeats times; the trajectory needs increasing ones.
            if pair is None or 1e-3 * pair.get_color_frame().get_timestamp() <= last_s:
                continue
            captured = self._captured(pair, index)
            last_s = captured.frame.timestamp_s
            yield captured
            index += 1

    def stop(self) -> None:
        """Stop the streams."""
        self._stopped.set()
        if self._started:
            self._started = False
            self._source.stop()

    def _next_pair(self) -> Any | None:
        """The next pair of images, None if none came in time or one of both is missing."""
        pair = self._source.wait(_WAIT_MS)
        if pair is None or not pair.get_depth_frame() or not pair.get_color_frame():
            return None
        return pair

    def _captured(self, pair: Any, index: int) -> CapturedFrame:
        """Align, convert and undistort a pair of images."""
        assert self._camera is not None
        captured_s = self._capture_time_s(pair.get_color_frame())
        aligned = self._align.process(pair)
        colour, depth = aligned.get_color_frame(), aligned.get_depth_frame()
        rgb = np.asanyarray(colour.get_data()).astype(np.float32) / np.float32(255.0)
        depth_m = np.asanyarray(depth.get_data()).astype(np.float32)
        depth_m *= np.float32(depth.get_units())
        if self._maps is not None:
            rgb = np.asarray(cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR))
            depth_m = np.asarray(cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST))
        timestamp_s = 1e-3 * colour.get_timestamp()
        return CapturedFrame(Frame(index, timestamp_s, rgb, depth_m, self._camera), captured_s)

    def _capture_time_s(self, colour: Any) -> float:
        """Time of capture if the camera reports it on a clock of the system; else of arrival."""
        domains = self._rs.timestamp_domain
        now_s = time.monotonic()
        if colour.get_frame_timestamp_domain() not in (domains.system_time, domains.global_time):
            return now_s
        age_s = time.time() - 1e-3 * colour.get_timestamp()
        return now_s - age_s if 0.0 <= age_s <= _MAX_AGE_S else now_s


class _Pipeline:
    """The pipeline of a connected camera."""

    def __init__(self, rs: Any, fps: int, serial: str | None) -> None:
        self._context = rs.context()
        self._pipeline, self._config = rs.pipeline(self._context), rs.config()
        if serial is not None:
            self._config.enable_device(serial)
        self._config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, fps)
        self._config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, fps)

    def start(self) -> None:
        if not len(self._context.query_devices()):
            raise RuntimeError("no device is connected")  # the library would wait for 15 s
        self._pipeline.start(self._config)

    def wait(self, timeout_ms: int) -> Any | None:
        done, frames = self._pipeline.try_wait_for_frames(timeout_ms)
        return frames if done else None

    def stop(self) -> None:
        self._pipeline.stop()


def _undistortion_maps(rs: Any, intrinsics: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps [H, W] of columns and rows in the camera's image for each undistorted pixel.

    The library's own projection is used, because two of its models are not those of OpenCV.
    """
    height, width = intrinsics.height, intrinsics.width
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    x = (columns - intrinsics.ppx) / intrinsics.fx
    y = (rows - intrinsics.ppy) / intrinsics.fy
    pixels = [
        rs.rs2_project_point_to_pixel(intrinsics, [a, b, 1.0])
        for a, b in zip(x.ravel().tolist(), y.ravel().tolist(), strict=True)
    ]
    maps = np.array(pixels, np.float32).reshape(height, width, 2)
    return maps[..., 0].copy(), maps[..., 1].copy()
