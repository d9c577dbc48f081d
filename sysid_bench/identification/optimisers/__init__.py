"""Optimisers of costs that are simulated, within a budget: SciPy, CMA-ES, mujoco.sysid."""
