"""Surveys of model files: collections of public models, causes of refusals, tables, baselines."""
