"""Detection of calibration boards in strongly distorted images: checkerboards and Kalibr's AprilTag grids.

Begin with `board.py`: what a board is, and its print. `checkerboard.py` finds checkerboards in steps:
candidates of corners at several scales (`corner_candidates.py`), chains of neighbours that make grids
(`corner_grid.py`), a local mapping that predicts further corners (`local_mapping.py`), and one score that accepts or
rejects a board. OpenCV's detectors assume straight lines, and find a third of the boards in mirrors. `aprilgrid.py`
joins OpenCV's detection of single tags to a grid and refines their corners. Images in, pixels of corners out: the
package opens no file.
"""
