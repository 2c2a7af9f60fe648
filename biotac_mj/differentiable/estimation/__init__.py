"""Contact from electrodes: `biotac lab estimate`, which inverts the simulator by gradients."""
