"""Camera models: pixels to rays and back."""
