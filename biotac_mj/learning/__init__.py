"""Learned models between the deformed skin and the electrodes: training, evaluation, use. torch is loaded
when a model is."""
