"""Visual odometry: the motion of the rig from one stereo frame to the next."""
