"""Recorded runs: reading them, and evaluating a trajectory against the truth.

`recording.py` reads the poses, states and commands of a recording into arrays; `evaluation.py` computes the errors of a
trajectory (ATE, RPE, heading, coverage), and fits the axes of a body whose truth is given (`omnid eval --frame auto`).
"""
