"""The state of a run in numbers: status entries, statistics, warnings about its input, progress.

`status.py` makes the entries for bus, page, recording and terminal from the `stats()` of each part of a run, with the
problem and its remedy in words, and the summary of a replay. The names are one table, `transport/status_names.py`.
"""
