"""Time of one inference: deformed skin -> 19 electrodes, by the networks that ship.

    python benchmarks/learning.py [--weights NAME_OR_FILE ...] [--device cuda] [--json FILE]

On the CPU one thread and one sensor; processor time is given too, since a wall clock means little on a busy
machine. On a GPU batches."""

import argparse
import functools
import statistics
import time

import torch
from records import write_json

from biotac_mj.geometry import load_skin
from biotac_mj.learning.weights import find_weights, load_forward


def measure(work, device, repeats):
    """Median wall clock and mean processor time of work() [s]."""
    for _ in range(3):
        work()
    wall = []
    begun = time.process_time()
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        wall.append(time.perf_counter() - start)
    return statistics.median(wall), (time.process_time() - begun) / repeats


@torch.no_grad()
def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", nargs="+", default=["forward", "latent_projection"])
    parser.add_argument("--skin", default="default")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--json")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    geometry = load_skin(args.skin)
    rows = []
    print(f"{'':<44}{'sensors':>8}{'us per sensor':>15}{'processor us':>14}   on {args.device}")
    for name in args.weights:
        model = load_forward(find_weights(name), geometry).to(args.device)
        for n in args.batches if args.device == "cuda" else [1]:
            u = 0.05 * torch.randn(n, geometry.nvert, 3, device=args.device)
            work = functools.partial(model.log_change, u)
            wall, cpu = measure(work, args.device, 50 if n == 1 else 20)
            rows.append(
                {
                    "network": name,
                    "sensors": n,
                    "us_per_sensor": 1e6 * wall / n,
                    "processor_us_per_sensor": 1e6 * cpu / n,
                }
            )
            print(f"{name:<44}{n:>8}{1e6 * wall / n:>15.1f}{1e6 * cpu / n:>14.1f}")
    if args.json:
        about = {
            "device": torch.cuda.get_device_name() if args.device == "cuda" else "cpu, one thread",
            "skin": args.skin,
            "torch": torch.__version__,
        }
        write_json(args.json, about | {"rows": rows})
    return rows


if __name__ == "__main__":
    main()
