"""One HTML page about a recording: what the robot did, how sure it was of it, and what went wrong."""
