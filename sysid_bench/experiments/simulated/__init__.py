"""Experiments on a simulated robot: prepare, record, preprocess, problem."""
