"""Random robots (trees, mechanisms with coupled joints) and random states of any robot."""
