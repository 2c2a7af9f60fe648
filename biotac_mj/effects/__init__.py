"""What real sensors have beyond the base model: one class an effect, each at its stage; the catalogue."""
