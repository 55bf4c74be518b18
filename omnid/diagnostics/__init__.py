"""The state of a run in numbers: status entries, statistics, warnings about its input, progress.

`status.py`: each part of a run gives its numbers (`stats()`), which are joined for bus, page, recording and terminal;
and what a replay reports at its end, with the exit code that follows. Where a part says what is wrong, it says so in
words and with a remedy; the names are one table, `transport/status_names.py`.
"""
