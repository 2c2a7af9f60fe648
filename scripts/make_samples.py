"""Makes biotac_mj/assets/samples.zip, what `biotac data samples` writes without a simulation.

    python scripts/make_samples.py

It takes a minute of processor time. A slow test of tests/test_samples.py says when the simulation has moved
away from what is shipped.
"""

import pathlib
import tempfile
import zipfile

from biotac_mj.samples import SHIPPED_SEED
from biotac_mj.samples.simulated import make_set, record_touches, tables

OUT = pathlib.Path(__file__).parents[1] / "biotac_mj" / "assets" / "samples.zip"


def main():
    recording = record_touches(SHIPPED_SEED)
    with tempfile.TemporaryDirectory() as folder:
        made = pathlib.Path(folder)
        for name, content in tables(recording).items():
            (made / name).write_bytes(content)
        make_set(recording, made / "set", SHIPPED_SEED, progress=True)
        with zipfile.ZipFile(OUT, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
            for path in sorted(p for p in made.rglob("*") if p.is_file()):
                about = zipfile.ZipInfo(
                    str(path.relative_to(made))
                )  # without a time: equal files, equal bytes
                archive.writestr(about, path.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    print(f"{OUT}: {OUT.stat().st_size} bytes")


if __name__ == "__main__":
    main()
