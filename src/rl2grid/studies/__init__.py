"""Studies and searches: many trainings and evaluations from one file."""
