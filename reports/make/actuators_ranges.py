"""Ranges of new files held against the file left out, as Markdown: `python -m
reports.make.actuators_ranges [SET...]`, and simulated robots where several units are there.

Each file of a set is left out in turn: the 90 % range that `identify` gives from the others, from
three of them on, either holds its value or not. Values on a bound in the file that is left out count,
too. The folder of the recordings is that of the variable SYSID_BENCH_DATA.
"""
