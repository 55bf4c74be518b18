"""The experiments of Dang et al. 2012, section V, rendered and measured: `python -m tests.bench.paper`."""
