"""What can be wrong with a plain recording: one module for each family of effects finds and fits them."""
