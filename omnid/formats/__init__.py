"""Files that omnid writes and reads besides logs and rigs.

Begin with `exports.py`: how a file is replaced at once, clouds (PLY) and grids (PGM, `map.yaml`). `tum.py` are
trajectories, `plan.py` the image of a plan, `place_file.py` maps of places (`.omap`), `route_file.py` taught routes.
`docs/formats.md` describes omnid's own formats. The package touches files only; wrong content is refused in one line.
"""
