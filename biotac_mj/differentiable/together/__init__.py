"""Presses of many worlds at once, on one device, and their gradients."""
