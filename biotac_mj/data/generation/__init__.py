"""How `biotac data generate` makes a set: plans, simulates, varies and reads synthetic interactions."""
