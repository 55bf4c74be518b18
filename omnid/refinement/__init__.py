"""Refinement of the rig while the daemon runs."""
