"""Regressors Y of tau = Y theta: dynamics that are linear in the inertial and joint parameters.

NumPy and compiled kernels, coupled joints, force/torque sensors, their adjoints, block-wise QR
accumulation, and independent reference regressors by Pinocchio (files `pinocchio*`).
"""
