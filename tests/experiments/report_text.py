"""The prose of the report: the setup of each experiment and the remarks on its results."""

from __future__ import annotations

HEAD = """# The paper's experiments and their results
Dang, Ly, Nguyen 2012, section V: the scenes of this folder with parabolic mirrors under orthographic cameras, noise,
blur and JPEG, 768 px. Each number is the median of all seeds, with the smallest and the largest in brackets.
```
for name in brick control smooth turns; do
    python -m tests.experiments render $name --seed 31 32 33 --out LOGS
done
python -m tests.experiments render two_walls --renderer ray_caster --seed 31 32 33 --out LOGS
python -m tests.experiments render building --renderer ray_caster --seed 47 --out LOGS
OPENBLAS_NUM_THREADS=1 python -m tests.experiments report LOGS
```
**Renderers.** POV-Ray 3.7 ray-traces a real mirror under a real camera and knows nothing of omnid's camera models; it
takes 3 to 5 s an image. The ray caster of `tests/simulation` casts the rays of the camera model itself; it is several
times faster. A test holds both to the same image (`test_scenes.py`: median difference below 0.03 px).

**Seeds.** A seed decides textures, path, rig and noise. 11 to 15 were rendered by POV-Ray and measured while the
methods were developed; the map's rule for how many frames must have seen a voxel (`mapping.min_frames`) was set on
building 11, so that its map is no test of this rule. 31 to 33 and 47 were rendered afterwards and had never been used
before. Nothing of omnid was changed after their results were known; only SIFT's contrast threshold was lowered, in
favour of SIFT, after brick wall 31. The rows of 11 to 15 are those of methods that have not changed since they were
measured.
"""

WALL = """## A wall of identical bricks (V.B, fig. 8), a control and a smooth wall (III.C)
2 m ahead of cameras at 1.2 m and 1.4 m. The control has a texture that does not repeat; the smooth wall has soft
clouds without edges. Only matches within 45 degrees of straight ahead count. Over 5 cm off: located so far from the
wall's plane. Over 20 cm off: mismatched, not only inexact. Completeness: share of the wall's edge pixels with a right
match, for the methods that try them all. Coverage: share of the 10 cm squares of the wall with a right match. All
points are triangulated from the same panoramas.

SIFT (contrast threshold 0.01: the default finds hardly any feature on these bricks) and Harris corners (sub-pixel,
described by patches of 15 px) are matched in two ways: anywhere, with Lowe's ratio test, and the matches that
contradict the epipolar geometry removed; or along the column like SAD, the best and mutually nearest.

![Points of a brick wall by three methods](brick.png)
"""

TURNS = """## Turns (IV.F, fig. 7)
500 corners tracked from one image to another between which the rig turns: to the left (+) from the first image of the
log to one that is turned, and to the right (-) the other way. "Moved" adds 6 cm of translation. Right: within 3 px of
the true pixel. Claimed: by Lucas and Kanade's status for plain KLT, by the backward check for the searches, which use
the same KLT. The stepwise search tries 0, +18, -18, +36 ... degrees. Time: processor time of one thread. The paper
reports 36 features for plain KLT and 91 for the search at 18 degrees.

![Features tracked correctly over the angle](turns.png)
"""

PATHS = """## Between two walls (V.C, fig. 9)
99 pairs 5 cm apart, a turn of 94 degrees just before the end. The paper reports 475.7 cm (-2.9 %) with plain and
488.7 cm (-0.27 %) with improved KLT, of 490 cm. The rows are the steps from the paper's method to omnid's, and both
methods without the Kalman filter (IV.D). In the paper's method the filter's output is the motion itself; omnid's
filter only predicts where to search, so without it the search starts at the last pose.

![Paths and their errors](two_walls.png)
"""

BUILDING = """## Around a building (V.D, fig. 10)
349 pairs, faster on the straight and slower in turns, ending where it began; no loop is closed. The map is judged by
its points within 4 m of the path, by their distance from the nearest true surface; mapped is the share of the walls,
where they are visible from less than 4 m, with a point within 10 cm. Without the Kalman filter only the path is
measured.

![Floor plan, map and path](building.png)
"""

SPEED = """## Speed (VI)
The first pairs of the two walls, one thread, processor time (the machine was shared, so elapsed time would measure
its other work). omnid and the paper's method track 500 features; SIFT is measured with its 500 strongest features of
each panorama and without a limit. SIFT's motion is estimated as in the paper: RANSAC on three points, Gauss-Newton on
eq. 9.
"""

WALL_REMARKS = ""
TURNS_REMARKS = ""
PATHS_REMARKS = ""
BUILDING_REMARKS = ""
SPEED_REMARKS = ""
