"""Live cameras: frames are processed as they arrive, and the newest one comes first."""
