"""`omnid listen`, `omnid drive`, `omnid goto` and `omnid route`: a robot followed and asked over the bus.

Begin with `robot_state.py`: the newest message of each topic of a robot, with counts of what was missed, and how
`omnid listen` shows it. `teleop.py` drives by the keyboard, `navigation.py` asks for goals and routes and waits for
their end. A client of the bus as any other: it imports no stage.
"""
