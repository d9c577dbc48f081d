"""Identification of simulated robots, recordings and actuators: requests, results, models."""
