"""Loop closure: from loop candidates to corrected keyframe poses and submap anchors."""
