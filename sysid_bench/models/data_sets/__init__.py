"""Data sets of recorded robots: descriptions, places of their files, and fetching."""
