"""Camera models: projection of points to pixels, and lifting of pixels to rays."""
