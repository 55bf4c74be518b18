"""Ends of the flow: bus, recorder, files, collectors."""
