"""The state of a run in numbers: status entries, statistics, warnings about its input, progress.

Begin with `status.py`: each part of a run gives its numbers (`stats()`), and this package joins them for bus, page,
recording and terminal. `run_summary.py` counts what a replay reports at its end, and the exit code that follows. Where
a part says what is wrong, it says so in words and with a remedy; the names are one table, `transport/status_names.py`.
"""
