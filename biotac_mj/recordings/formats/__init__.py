"""File formats of recordings: a reader for each kind of file or message, and the names of columns."""
