"""A simulated robot in a simulated world: `omnid simulate`, and the tests.

Begin with `world.py`: a world is a TOML file of walls, boxes, floors, people and a start pose. `robot.py` moves
a base by the commands of the controller, `rendering/` casts the images of both cameras, `paced_robot.py` lets the
daemon drive it in its own time. `tests/simulation/lockstep.py` steps robot and stages together.
"""
