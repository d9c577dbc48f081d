"""Errors of the identified model, as plug-ins: one file per error.

`apply(robot, rng)` gives the plant's robot from that of the model (`simulation/plant_robot.py`).
"""
