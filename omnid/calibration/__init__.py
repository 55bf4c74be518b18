"""What stands between the calibration's commands and its numerics: images in, reports out."""
