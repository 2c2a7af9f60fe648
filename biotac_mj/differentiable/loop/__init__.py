"""Reverse mode of MuJoCo's steps with BioTacs: `rollout`."""
