"""Identifiability of dynamic parameters: base parameters, verdicts and structural nullspaces.

Symbolic coefficients, sign bounds by physical feasibility, and identifiable subspaces of sub-trees
distal to force/torque sensors.
"""
