"""Months of realistic series for every grid, made in seconds, the same on every machine."""

from rl2grid.scenarios.generator.month import generate_month

__all__ = ["generate_month"]
