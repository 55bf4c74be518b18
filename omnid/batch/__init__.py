"""Many logs: each is replayed by a program of its own, on this machine or on others, into one folder and one table."""
