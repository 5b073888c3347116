"""Training: settings, engines, checkpoints, and the export to a policy file."""
