"""Agents that need no training, and what every agent offers."""
