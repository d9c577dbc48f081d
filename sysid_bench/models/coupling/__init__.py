"""Coupled joints: mimic joints, tendon and joint equalities, closed chains.

equalities.py reads them as constraints.py on the coordinates of coordinates.py; group.py solves the
closure and bounds it, build.py chooses what moves and joins the groups, and coupling.py holds the
result. pullback.py: derivatives for excitation design.
"""
