"""Logs: reading of MCAP files, bags and folders of images; writing and rotation of MCAP files."""
