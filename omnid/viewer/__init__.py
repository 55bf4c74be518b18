"""A run in images, for rerun: of a log, of a recording, or of a robot as it drives."""
