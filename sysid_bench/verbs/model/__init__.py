"""Robot models: cross-check, base parameters, frames, lint, surveys."""
