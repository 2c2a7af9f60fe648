"""Where `read_columns` was: it is `recordings.columns`'."""

from ..recordings.columns import read_columns

__all__ = ["read_columns"]
