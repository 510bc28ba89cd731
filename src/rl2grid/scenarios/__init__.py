"""Time series: where they come from, how they are split, and which one an episode plays."""
