"""Meshes with a card each; data only."""
