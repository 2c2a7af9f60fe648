"""Readings of a sensor as differentiable PyTorch functions: film, counts, heat."""
