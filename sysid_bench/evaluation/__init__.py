"""Evaluation of estimates: scores, covariances, Cramer-Rao bounds, statistics over repeats, robots.

Also the cross-checks of a robot's model between MuJoCo and Pinocchio.
"""
