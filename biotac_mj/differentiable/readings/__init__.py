"""What a sensor reads, as functions that PyTorch differentiates: film, counts, heat."""
