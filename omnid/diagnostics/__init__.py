"""The state of a run: status entries, statistics, warnings, progress."""
