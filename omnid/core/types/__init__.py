"""Types that stereo, odometry, places and obstacles share: data, and no algorithm.

Begin with `panorama.py`: a panorama with its padding across the seam, noise and visible part. `pixel_times.py` says
when each pixel was exposed against the stamp of the pair; `stereo_model.py` is the cylinder and the baseline by which a
pixel and a disparity are a point.
"""
