"""What panoramas say about the calibration of the rig."""
