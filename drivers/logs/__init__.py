"""Logs: reading, writing, recovery and rotation of MCAP files."""
