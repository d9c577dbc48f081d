"""Suites and their run folders: run, report, tables, figures, comparison, gates, sites."""
