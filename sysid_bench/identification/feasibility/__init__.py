"""Physical consistency: feasible set, LMI and log-det fits, log-Cholesky coordinates and
completion."""
