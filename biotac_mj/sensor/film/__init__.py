"""The liquid film between core and skin, and the impedances of its electrodes."""

from .conduction import (
    CONDUCTIVITY,
    EXCITATION,
    BatchFilm,
    FilmConduction,
    NoFilmError,
    excitation_places,
    read_film,
    spreading_resistance,
    spreading_table,
)

__all__ = [
    "CONDUCTIVITY",
    "EXCITATION",
    "BatchFilm",
    "FilmConduction",
    "NoFilmError",
    "excitation_places",
    "read_film",
    "spreading_resistance",
    "spreading_table",
]
