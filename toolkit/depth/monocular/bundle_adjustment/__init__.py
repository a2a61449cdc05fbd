"""Bundle adjustment: poses of keyframes and inverse depths of landmarks from image points."""
