"""Runs from the opening of their inputs to their result: live, replay, record.

Begin with `wiring.py`: `wire` joins the stages as the figure in ARCHITECTURE.md shows. `live.py` is the daemon,
`replay.py` a log, `session.py` what both share. `place_maps.py` and `route_files.py` are the threads that touch files
for the stages; `systemd.py` reports to the service manager. A run opens its inputs, wires, runs until the end or a
failure, and closes in the opposite order.
"""
