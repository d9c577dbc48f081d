"""Regressors Y of tau = Y theta: dynamics that are linear in the inertial and joint parameters.

NumPy and compiled kernels, coupled joints, force/torque sensors, their adjoints, block-wise QR
accumulation, and independent reference regressors by Pinocchio (files `pinocchio*`).

From Python, regressors along a motion with the names of their rows and columns:

    regression.regression(robot, columns).dense(motion)            joint torques of a tree
    coupled.torque_regression(robot, columns)                      the same with joint couplings
    wrench.base_wrench_regressor(robot, cut, motion, base)         Y_n of a sub-tree behind a sensor
    wrench.joint_torque_regressor(robot, cut, motion, base)        Y_c, for any base link
"""
