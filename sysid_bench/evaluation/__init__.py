"""Evaluation of estimates: scores, covariances, Cramer-Rao bounds and statistics over repeats.

Also the cross-checks of a robot's model between MuJoCo and Pinocchio.
"""
