"""`python -m biotac_mj`: the command line, where `biotac` is not on the path."""

from .cli import main

if __name__ == "__main__":
    raise SystemExit(main())
