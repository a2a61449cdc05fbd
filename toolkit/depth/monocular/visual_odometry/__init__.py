"""Visual odometry: camera motion and sparse structure from the images of one camera."""
