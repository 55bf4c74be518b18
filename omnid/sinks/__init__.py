"""Where messages leave the flow: bus, recorder, files."""
