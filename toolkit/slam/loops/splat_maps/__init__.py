"""Maps of other tools: a camera is located in a file of splats that has no keyframes."""
