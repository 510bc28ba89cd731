"""Training runs, evaluations and rankings."""
