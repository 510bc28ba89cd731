"""Agents playing episodes: the protocol of evaluation, recordings to be watched, the ranking of actions."""
