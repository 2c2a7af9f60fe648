"""Learned models between the deformed skin and the electrodes: training, evaluation, use. torch is imported
with the first model."""
