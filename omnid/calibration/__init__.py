"""What stands between the calibration's commands and its numerics: pictures in, reports out."""
