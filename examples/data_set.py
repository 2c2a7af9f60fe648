"""Make a small synthetic set, split it by interaction, predict electrodes from the skin by regression: python
examples/data_set.py"""

import argparse
import tempfile

import numpy as np

from biotac_mj.data import GenerateOptions, TactileSet, generate, split_by_interaction

MODES = 12  # of the deformation that the regression sees


def features(data, interactions, basis=None):
    """Modes of the displacement (POD) and tared counts of all time steps of some interactions."""
    step = data.steps(interactions)
    u = data["displacement"][step].reshape(len(step), -1)
    if basis is None:
        basis = np.linalg.svd(u, full_matrices=False)[2][:MODES].T
    tare = np.repeat(data.start[interactions], data.stop[interactions] - data.start[interactions])
    return u @ basis, data["counts"][step][:, :19] - data["counts"][tare][:, :19], basis


def main(out=None, count=24, steps=10, skin="coarse", tier="condensed", progress=True):
    """Returns the RMS errors over the test interactions [counts]: of the regression, and of predicting no
    change at all."""
    with tempfile.TemporaryDirectory() as folder:
        options = GenerateOptions(
            count=count, labelled=0, steps=steps, skin=skin, tier=tier, objects=("sphere_7mm", "table_edge")
        )
        report = generate(out or folder, options, workers=0, progress=progress)
        print(
            f"{report.interactions} interactions of {steps} time steps, "
            f"{report.nonconverged} steps not converged"
        )
        with TactileSet(out or folder) as data:
            split = split_by_interaction(data, fractions=(0.7, 0.1, 0.2))
            x, y, basis = features(data, split.train)
            weights = np.linalg.solve(x.T @ x + 1e-3 * np.trace(x.T @ x) / MODES * np.eye(MODES), x.T @ y)
            x, y, _ = features(data, split.test, basis)
    error, still = (float(np.sqrt(np.mean(e**2))) for e in (x @ weights - y, y))
    print(f"unseen interactions: {error:.0f} counts RMS from {MODES} modes, {still:.0f} from none")
    return error, still


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", help="folder that keeps the set")
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--tier", default="condensed", choices=("full", "condensed"))
    args = parser.parse_args()
    main(args.out, args.count, tier=args.tier)
