"""The daemon of a robot with two stacked omnidirectional cameras: stages, their wiring, the bus, the command line."""

__version__ = "0.1.0"
