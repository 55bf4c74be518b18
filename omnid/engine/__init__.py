"""Threads, queues, clocks and settings of the process; nothing about robots.

Begin with `graph.py`: stages, their counters, the bounded inbox of each, and how a run ends and fails. `robot_clock.py`
follows the offset of the monotonic clock to Unix time, `process.py` sets priorities and locks memory, `kernel_cache.py`
keeps compiled loops, `logging_setup.py` is the log. Nothing here knows what a message means.
"""
