"""Denavit-Hartenberg tables: read from CSV (dh_table.py) and turned into MJCF (dh_robot.py)."""
