"""Input and output of the calibration commands: images, board search, reports."""
