"""MuJoCo's steps with BioTacs in them, backwards: `rollout`."""
