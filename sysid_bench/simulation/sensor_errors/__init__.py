"""Errors of encoders, torque sensing and logging, as plug-ins: one file per error.

`prepare(robot, rng)` gives a stage of the sensor chain (`simulation/sensor_chain.py`).
"""
