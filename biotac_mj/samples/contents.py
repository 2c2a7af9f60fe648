"""What the samples are of."""

__all__ = ["EFFECT", "EVERY", "OBJECT", "PLACES", "SKIN", "TOUCHES"]

OBJECT, SKIN = "sphere_7mm", "coarse"
# round after round at the same places, each time to another depth: force is learned where it is asked for
PLACES, TOUCHES = 10, 50
# log.csv has the first round, every fifth row: `biotac diagnose` solves the skin in each again and again
EVERY = 5
# what the recorded sensor has and the simulated one lacks, for `biotac diagnose` to find
EFFECT = ("warmup", {"a": -0.25, "tau": 5.0})
