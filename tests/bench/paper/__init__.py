"""The experiments of Dang et al. 2012, section V, rendered by POV-Ray and measured: `python -m tests.bench.paper`."""
