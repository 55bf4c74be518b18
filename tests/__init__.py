"""Tests of omnid, its drivers and its geometry.

BLAS has one thread here, as in the commands: its threads wait for the next matrix without sleeping, which takes half of
the processor time of some tests, and of what benchmarks measure.
"""

from omnid.cli import limit_blas_threads

limit_blas_threads()  # before numpy is loaded
