"""The service, and the viewer in a browser."""
