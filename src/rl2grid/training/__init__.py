"""Training runs: their folders, validation, tracking and energy."""
