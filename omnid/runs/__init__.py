"""Runs from the opening of their inputs to their result: live, replay, record."""
