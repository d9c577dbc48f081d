"""Coupled joints: mimic joints, tendon and joint equalities, closed chains.

mimic.py and equalities.py read them as constraints.py (closed chains: joint_chain.py) on the
coordinates of coordinates.py; independent_joints.py chooses what moves, group.py solves the
closure, closure_limits.py bounds it, build.py joins the groups, and coupling.py holds the result.
pullback.py: derivatives for excitation design.
"""
