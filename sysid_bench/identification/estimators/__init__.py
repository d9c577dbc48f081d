"""Estimators, one per file: frozen settings with `solve(problem)` or `fit(experiment)`."""
