"""The odometry of Dang, Ly, Nguyen (2012), section IV, as published."""
