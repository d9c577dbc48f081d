"""Coupled joints: mimic joints (mimic.py), tendon and joint equalities, closed chains (chain.py).

equalities.py reads constraints from MuJoCo, independent_joints.py chooses what moves, group.py
solves the closure, closure_limits.py bounds it, and coupling.py holds the result.
"""
