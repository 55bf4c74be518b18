"""Check of the rig's calibration by its panoramas."""
