"""A run drawn by Rerun: of a log while it is replayed, of a recording, or of a live robot on the bus.

`rerun_sink.py` is the one sink: it takes poses, states, panoramas, maps, obstacles and status, and draws them in the
frames map, odom and base. Rerun is an optional package (the extra `view`), imported when a viewer is opened.
`foxglove.json` is a layout for Foxglove, which opens the recordings themselves.
"""
