"""What a process keeps of models that are gone: its memory over cycles of attach, compile, step and delete.

    python benchmarks/lives.py --cycles 1000 --json out/lives.json [--skin coarse] [--tiers full,condensed]

Every cycle has a material of its own and the next of the tiers, and presses a ball into the skin for a few
steps. Its caches on disk are a folder of its own. The memory is the resident one after a garbage collection,
with what the allocator holds free given back; the first cycles, in which kernels are loaded and
every tier has been at work, are not counted."""

import argparse
import ctypes
import gc
import os
import pathlib
import sys
import tempfile
import time

from records import write_json
from startup import press_ball

__all__ = ["lives", "main", "resident"]

WARM_UP, STEPS = 16, 3


def resident() -> float:
    """Megabytes of memory that this process holds, after a collection and without what is only kept free."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def lives(
    cycles: int, tiers: tuple[str, ...] = ("full", "condensed"), skin: str = "coarse", every: int = 1
) -> list[tuple[int, float]]:
    """Cycle and memory [MB] then, of every `every`-th after the warm-up and of the last. Every model has a
    material that no other has."""
    out = []
    for i in range(WARM_UP + cycles):
        material = {"youngs_modulus": 5e5 * (1 + 1e-4 * i)}
        press_ball(STEPS, skin=skin, tier=tiers[i % len(tiers)], material=material)
        done = i + 1 - WARM_UP
        if done >= 0 and (done % every == 0 or done == cycles):
            out.append((done, resident()))
    return out


def main(arguments=None) -> int:
    """The command; writes the JSON and prints the growth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--tiers", default="full,condensed")
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/lives.json")
    args = parser.parse_args(arguments)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["BIOTAC_CACHE"] = folder
        rows = lives(args.cycles, tuple(args.tiers.split(",")), args.skin, max(1, args.cycles // 50))
    growth = rows[-1][1] - rows[0][1]
    found = {
        "cycles": args.cycles,
        "growth_mb": growth,
        "mb_per_cycle": growth / args.cycles,
        "seconds": time.perf_counter() - begin,
        "memory_mb": rows,
    }
    write_json(args.json, found)
    print(f"{args.cycles} models: {rows[0][1]:.0f} MB after the first, {growth:+.1f} MB since", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
