"""Linearisation of a step at its equilibrium with respect to all its inputs."""
