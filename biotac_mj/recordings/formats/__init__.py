"""What recordings come as: a reader for each kind of file or message, and what columns are called."""
