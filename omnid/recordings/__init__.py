"""Recorded runs: reading them, and evaluating a trajectory against the truth.

`recording.py` yields the messages of one robot of a recording, decoded; `evaluation.py` computes the errors of a
trajectory (ATE, RPE, heading, coverage), and fits the axes of a body whose truth is given (`omnid eval --frame auto`).
"""
