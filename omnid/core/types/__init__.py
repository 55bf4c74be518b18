"""Types that stereo, odometry, places and obstacles share: the panorama image, the camera of a pair."""
