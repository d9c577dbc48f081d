"""Comparison of runs: values of each cell, tolerances, changes, baselines."""
