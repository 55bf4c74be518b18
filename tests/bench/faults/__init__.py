"""The campaign of attacks and faults against the daemon: `python -m tests.bench.faults --help`."""
