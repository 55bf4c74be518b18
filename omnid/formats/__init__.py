"""Files that omnid writes and reads besides logs and rigs.

`tum.py` are trajectories, `exports.py` clouds (PLY) and grids (PGM, `map.yaml`), `plan.py` the image of a plan,
`place_file.py` maps of places (`.omap`) and `route_file.py` taught routes. omnid's own formats are described in
`docs/formats.md`. Files are written under a temporary name and renamed; readers refuse wrong content in one line.
"""
