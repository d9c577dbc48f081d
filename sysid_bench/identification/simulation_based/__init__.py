"""Estimation by simulation: Gauss-Newton, output error, forward dynamics, joint filters."""
