"""The ends of the flow: files, log, bus, motor, and what a person at a terminal sees."""
