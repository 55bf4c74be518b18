"""`omnid listen`, `omnid drive`, `omnid goto` and `omnid route`: clients that show a robot and send it requests.

Begin with `robot_state.py`: the newest message of each topic of a robot, with counts of what was missed, the
display of `omnid listen`, stops, and the progress of a drive until its end. `teleop.py` drives by the keyboard. The
package imports no stage.
"""
