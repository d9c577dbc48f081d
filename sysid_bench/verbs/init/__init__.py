"""First files: robots, logs, suites, plug-ins."""
