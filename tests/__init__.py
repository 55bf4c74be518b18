"""Tests of omnid, its drivers and its geometry.

BLAS has one thread here, as in the commands: its threads wait for the next matrix without sleeping, which takes half of
the processor time of some tests, and of what benchmarks measure.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is loaded
