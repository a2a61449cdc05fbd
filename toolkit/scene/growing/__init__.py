"""Objects, their relations and rooms while the camera moves."""
