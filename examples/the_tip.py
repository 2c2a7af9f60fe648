"""Where two real sensors and the simulation disagree alike, and which mechanisms could be why.

    BIOTAC_RECORDINGS=FOLDER python examples/the_tip.py [--out DIR]
    python examples/the_tip.py --press E1.txt F1.txt --press E2.txt F2.txt

FOLDER holds flat presses on a force plate: epfl_flat_press/SynImpF1.txt with ForceData.txt, and
epfl_f2/SynImpF2.txt.gz with ForceData.txt.gz. Every row gets the pose of the simulated plate that fits it;
then each mechanism is tried as one number more, on blocks of time that it was not fitted on, and what is
named is judged on the last 30 % of the rows. The first time states of the skin are solved: ten minutes of
processor time."""

import argparse
import os
import pathlib
import sys

from biotac_mj.discrepancy.recordings.recording import read_recording
from biotac_mj.discrepancy.verbs import diagnose_with_states

PRESSES = (
    ("epfl_flat_press/SynImpF1.txt", "epfl_flat_press/ForceData.txt"),
    ("epfl_f2/SynImpF2.txt.gz", "epfl_f2/ForceData.txt.gz"),
)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--press", nargs=2, action="append", metavar=("E", "F"), help="electrodes and force")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/the_tip"))
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    given = parser.parse_args(argv)
    folder = os.environ.get("BIOTAC_RECORDINGS")
    if not (given.press or folder):
        sys.exit("the_tip: no recordings: set BIOTAC_RECORDINGS to their folder, or give --press E.txt F.txt")
    presses = given.press or [[pathlib.Path(folder) / name for name in pair] for pair in PRESSES]
    try:
        diagnose_with_states([read_recording(*pair) for pair in presses], given.out, given.quiet)
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"the_tip: {error}")


if __name__ == "__main__":
    main()
