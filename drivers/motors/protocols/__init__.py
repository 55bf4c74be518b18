"""Protocols of motor controllers: commands to bytes and back, no I/O."""
