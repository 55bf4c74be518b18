"""One HTML page about a recording: what the robot did, how certain it was, and what went wrong.

Begin with `report.py`: the list of charts and tables. `recorded_run.py` reads a recording into arrays once, `charts.js`
draws them with a small vendored library, `page.py` has the style that reports of calibrations share. The package reads
a log and returns text; the page needs no network.
"""
