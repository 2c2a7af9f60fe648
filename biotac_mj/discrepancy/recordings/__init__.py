"""Diagnosis of plain recordings: counts, perhaps with force, without poses."""
