"""Is the rig right? Evidence by the columns of its panoramas, and one state machine; see `rig_health.py`."""
