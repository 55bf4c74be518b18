"""Stages of the flow, one class each: the state and the glue around the numerics of `omnid.core`.

Begin with `front_end.py`: from a pair to a pose. A stage has `process(message) -> message | None`, keeps its own state,
reads no clock and opens no file; what it needs comes at construction or in a message. `omnid/runs/wiring.py` joins
stages; `omnid/engine/graph.py` gives each its thread and inbox. `synchronise.py` pairs images and samples of wheels and
gyro; `geometry.py` makes panoramas and dense depth of a pair.
"""
