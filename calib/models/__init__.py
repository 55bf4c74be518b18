"""Camera models: projection of points to pixels, and lifting of pixels to rays.

Begin with `camera.py`: the interface `OmniCamera` (`project`, `lift`, size, centre) and the mask of an image. Each
model is a frozen dataclass: the unified model for mirrors and pinholes (`unified.py`), OCamCalib's polynomial
(`ocam.py`), and lenses and stitched images (`lens.py`). `names.py` is the one table of models and of the names of their
parameters; files, fits and covariances use it. `wavefront.py` describes mirrors whose rays do not meet in one point.
Points without an image and pixels without a ray are NaN. The models touch nothing but numpy. A new model is a class, a
row in `names.py`, and rows in the tests of `test_camera.py`.
"""
