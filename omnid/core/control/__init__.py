"""Control laws and safety rules of the base, run in the process that steers: no numpy, no I/O, no clock.

Begin with `control_law.py`: one step turns the newest pose, command and scan into a command to the wheels, and says why
they are stopped. `safety_rules.py` is the table of reasons in their order, `arming.py` decides who may drive; the
heading is controlled in `heading_controller.py`; limits come last. The collision monitor (`collision_monitor.py`) slows
down and stops before obstacles and before what is unknown; `motion_monitor.py` compares commands, wheels, gyro and
images. Every rule has a hazard in `docs/safety.md` and a test with its mark; random walks with an oracle test them
together.
"""
