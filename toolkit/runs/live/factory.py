"""Selects the camera by its name in the options."""

from __future__ import annotations

from toolkit.base.errors import SettingsError
from toolkit.runs.live.camera import LiveCamera
from toolkit.runs.live.execution import check_live_settings
from toolkit.runs.live.options import LiveOptions
from toolkit.runs.live.replay import ReplayCamera
from toolkit.runs.recordings import open_recording
from toolkit.runs.settings import RunSettings


def build_camera(options: LiveOptions, settings: RunSettings) -> LiveCamera:
    """Build the camera of a live run; it is not started.

    Raises:
        SettingsError: the settings do not work with a live camera.
        DependencyError: the package of its driver is missing.
        ToolkitError: the dataset of a replay is missing or inconsistent.
    """
    check_live_settings(settings)
    if options.camera == "realsense":
        from toolkit.runs.live.realsense import RealSenseCamera

        return RealSenseCamera(options.fps, options.serial)
    if settings.dataset.path is None:
        raise SettingsError("--camera replay needs a dataset; add --dataset.path")
    dataset = open_recording(settings, settings.dataset.path)
    return ReplayCamera(dataset, options.fps or settings.pace or None)
