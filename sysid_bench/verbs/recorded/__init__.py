"""Recordings and data sets: diagnosis, twins, transfer, limits, download."""
