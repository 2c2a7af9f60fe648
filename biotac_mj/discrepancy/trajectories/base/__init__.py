"""Errors of the base model itself: nuisance parameters fitted with every effect, and named ones."""
