"""`omnid listen`, `omnid drive`, `omnid goto` and `omnid route`: a robot followed and asked over the bus.

Begin with `robot_state.py`: the newest message of each topic of a robot, with counts of what was missed, how
`omnid listen` shows it, stops, and the progress of a drive until its end. `teleop.py` drives by the keyboard. A client
of the bus as any other: it imports no stage.
"""
