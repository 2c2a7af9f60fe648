"""Training on data sets: tensors, features, the training loop, all models on all splits and seeds."""
