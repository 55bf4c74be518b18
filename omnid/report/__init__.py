"""One HTML page about a recording: what the robot did, how certain it was, and what went wrong.

`recorded_run.py` reads a recording into arrays once, `report.py` is the list of charts and tables, `charts.js` draws
them with a small vendored library, `page.py` has the style that reports of calibrations share. The page needs no
network.
"""
