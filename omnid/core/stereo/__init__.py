"""Stereo matching of two panoramas along their columns, and triangulation.

Begin with `matcher.py`: edges, the search along each column, and its two methods: a semi-global prior with SAD around
it (`semiglobal.py`, the default), and the paper's enhanced SAD with anchors (`anchors.py`).
`triangulation.py` turns disparities into points with covariance. `tiles.py` and `photometry.py` measure where images
are dead, dark or noisy, before anything is matched.
"""
