"""Contact from electrodes: `biotac estimate`, which inverts the simulator by its gradients."""
