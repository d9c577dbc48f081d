"""Experiments from recorded logs: prepare, preprocess, problem."""
