"""Levels over time: drifts, steps, jumps, warmth."""
