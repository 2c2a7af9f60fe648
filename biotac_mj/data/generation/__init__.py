"""`biotac data generate`: plans, simulates, varies and reads synthetic interactions."""
