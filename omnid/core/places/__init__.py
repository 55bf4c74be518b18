"""Recognition of places seen before, and the pose they give."""
