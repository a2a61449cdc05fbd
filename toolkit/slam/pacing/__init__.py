"""Real-time operation: frames arrive at camera rate, and mapping uses the time that remains."""
