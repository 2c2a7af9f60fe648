"""How `biotac generate` makes a set: plans, simulates, varies and reads synthetic interactions."""
