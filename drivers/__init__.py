"""Hardware and logs: cameras, MCAP files, motors. Imports neither `calib` nor `omnid`."""
