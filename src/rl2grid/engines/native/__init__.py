"""The native engine: Grid2Op's step, compiled, for many environments at once, without Grid2Op."""
