"""Simulation of a robot by MuJoCo: inverse dynamics, tracking control, sensors, unmodelled effects.

Independent of the regressors and estimators that are tested on its data.
"""
