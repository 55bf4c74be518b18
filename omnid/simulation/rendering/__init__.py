"""Images of textured worlds by ray casting, for mirrors and lenses.

Begin with `ray_caster.py`: it casts rays of a camera model to the surfaces of a world (`surfaces.py`), in compiled
loops (`ray_caster_kernels.py`), and adds exposure, noise and blur of a sensor. Benchmarks add lamps, glass and polished
floors of their own in `tests/simulation`.
"""
