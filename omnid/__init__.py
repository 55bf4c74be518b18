"""The daemon: stages, their wiring, the bus and the command line of a robot with two stacked omnidirectional cameras."""

__version__ = "0.1.0"
