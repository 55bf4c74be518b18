"""The process that steers the base, and the daemon's link to it."""
