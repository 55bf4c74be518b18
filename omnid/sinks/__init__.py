"""Ends of the flow: bus, recorder, files, controller.

A sink takes messages and returns nothing. Begin with `encoder.py`: it turns them into bytes and publishes them.
`recorder.py` writes MCAP files, `files.py` trajectories, `drive.py` sends to the controller. Each has a bounded inbox;
live, a slow disk or network drops the oldest messages, which are counted, and never delays a stage.
"""
