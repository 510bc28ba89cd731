"""Results that anyone can check: entries whose actions are played again."""
