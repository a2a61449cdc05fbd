"""Loop closure as a whole: from what looks alike to anchors that moved."""
