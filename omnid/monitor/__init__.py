"""A robot watched over the bus: what came is counted, kept in files and shown."""
