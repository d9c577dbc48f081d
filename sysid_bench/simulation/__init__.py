"""Simulation of a robot by MuJoCo: inverse dynamics, tracking control, sensors and unmodelled effects.

Independent of the regressors and estimators that are tested on its data.
"""
