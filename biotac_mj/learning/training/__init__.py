"""Training on data sets: tensors, features, the loop, every model on every split and seed."""
