"""Data sets of recorded robots: their descriptions, where their files are, and how they get there."""
