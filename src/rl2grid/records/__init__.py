"""What is stored: episodes, evaluations, trainings, entries, recordings; and their statistics."""
