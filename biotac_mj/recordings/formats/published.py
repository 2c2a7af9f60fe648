"""Published data sets: files that belong together, and the meaning of their names."""

import pathlib
import re

# File name -> names of files logged with it.
_COMPANIONS = (
    (re.compile(r"(.+)_bio(\.csv(?:\.gz)?)"), (r"\1_cp\2", r"\1_cw\2")),  # slides over materials
    (re.compile(r"sense_R_[LR]F(\.txt(?:\.gz)?)"), (r"position\1", r"orientation\1")),  # scraping
)
_HOLD = re.compile(r"(.+)_\d+_HOLD\.mat")  # PHAC-2's holds: object_number_trial_HOLD.mat
_SLIDE = re.compile(r"(mat\d+)_\d+_bio\.csv(?:\.gz)?")
# velocities that are not a number, and joint angles
_NOT_READ = re.compile(r".+_cv\.csv(?:\.gz)?|sense_proprio\.txt(?:\.gz)?")


def is_companion(path: pathlib.Path) -> bool:
    """Whether a file of a data set has nothing that a recording can hold."""
    return _NOT_READ.fullmatch(path.name) is not None


def companions(path: pathlib.Path) -> list[pathlib.Path]:
    """Other files that belong to this one."""
    for pattern, others in _COMPANIONS:
        found = pattern.fullmatch(path.name)
        if found:
            candidates = [path.parent / found.expand(other) for other in others]
            return [one for one in candidates if one.is_file()]
    return []


def object_of(path: pathlib.Path) -> str:
    """Touched object by the file's name, "" if unknown."""
    if found := _HOLD.fullmatch(path.name):
        return found[1]
    if found := _SLIDE.fullmatch(path.name):
        table = path.parent / "MATERIALS.txt"
        lines = table.read_text(errors="replace").splitlines() if table.is_file() else []
        return next((line for line in lines if line.split()[:1] == [found[1]]), found[1])
    return ""


def rate_of(path: pathlib.Path) -> float | None:
    """Row rate [Hz] of a data set without times that was published with its rate."""
    return 100.0 if _HOLD.fullmatch(path.name) else None
