"""Ends of the flow: bus, recorder, files, controller.

A sink takes messages and returns nothing: `encoder.py` turns them into bytes and publishes them, `recorder.py`
writes MCAP files, `files.py` writes trajectories and maps, `drive.py` sends to the controller. Each has a bounded
inbox; live, a slow disk or network drops the oldest messages, which are counted, and never delays a stage.
"""
