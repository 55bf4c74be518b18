"""Ends of the flow: bus, recorder, files, controller.

A sink takes messages and gives nothing back: `encoder.py` turns them into bytes and publishes them, `recorder.py`
writes MCAP files, `files.py` writes trajectories and maps, `drive.py` sends to the controller. Each has a bounded
inbox; a slow disk or network drops the oldest and is counted, and never holds a stage up.
"""
