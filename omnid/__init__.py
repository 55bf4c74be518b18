"""The daemon: stages, wiring, transport and command line."""
