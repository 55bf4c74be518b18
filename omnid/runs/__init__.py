"""Runs from the opening of their inputs to their result: live, replay, record.

Begin with `wiring.py`: `wire` joins the stages as the figure in ARCHITECTURE.md shows. `live.py` is the daemon,
`replay.py` a log, `Session` what both share. `files.py` reads and writes maps of places and routes. A run opens its
inputs, wires, runs until the end or a failure, and closes in the opposite order.
"""
