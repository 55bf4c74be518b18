"""Protocols of motor controllers: commands to bytes and back, no I/O.

Begin with `motor_protocol.py`: a protocol is two transactions, `connect` and `drive`, written as generators that yield
bytes and receive frames; the driver runs them up to a deadline. `DifferentialDrive` converts velocity and yaw rate
to the speeds of the two channels. One file for each controller follows: `line_protocol.py` (own firmware),
`roboteq.py`, `odrive_ascii.py`, `vesc.py`. `serial_motor.py` lists them, and loads those that other packages add
by an entry point. None has met a real board yet: `tests/contract` runs the same rules on all of them against simulated
controllers that check each byte.
"""
