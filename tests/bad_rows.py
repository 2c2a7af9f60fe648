"""A row of the tables of bad input, and how an HDF5 file is broken."""

import dataclasses
from collections.abc import Callable

import h5py


@dataclasses.dataclass
class Row:
    """words: of the command line, those that name a valid file get it. text: in the message. file, change:
    change(path) breaks that file."""

    words: str
    text: str
    file: str = ""
    change: Callable = lambda path: None

    def __str__(self):
        return f"{self.words} | {self.text}"[:120]


# --- ways to break a file


def h5(change):
    def do(path):
        with h5py.File(path, "a") as file:
            change(file)

    return do


def replaced(old, new):
    """Replaces a text in a file that has it."""

    def do(path):
        before = path.read_text()
        assert old in before
        path.write_text(before.replace(old, new, 1))

    return do
