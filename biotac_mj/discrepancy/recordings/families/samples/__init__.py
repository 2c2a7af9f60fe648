"""Rows that are missing, held, coarse, clipped or stuck."""
