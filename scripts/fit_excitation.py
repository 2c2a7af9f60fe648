"""Where the four excitation electrodes of the film model may sit: fits EXCITATION and CONDUCTIVITY of
biotac_mj/sensor/film/conduction.py.

Their positions are not published for this sensor. They are taken as two pairs on the core, each symmetric
about z = 0, whose film impedances at rest come nearest to the published rest counts: least RMS of
ln(published / film) after its mean, over the mean pattern of the three published sensors. Four numbers are
fitted to 19 that symmetry makes about 12, so this is an estimate, not a measurement; the list of local optima
shows how flat it is. EXCITATION is the best on the paper's mesh (import it, then pass --skin); takes a
minute.

    python scripts/fit_excitation.py [--skin default]
"""

import argparse
import itertools

import numpy as np
from scipy.optimize import minimize

from biotac_mj.sensor.channels import REST_COUNTS, impedance_from_counts
from biotac_mj.sensor.film import CONDUCTIVITY, FilmConduction

# [m] between the centres of any two discs, so that their footprints in the sheet do not overlap
CLEARANCE = 1.7e-3


def target():
    """(19,) mean ln Z at rest of the published sensors."""
    return np.mean([np.log(impedance_from_counts(counts)) for counts in REST_COUNTS.values()], axis=0)


def pairs(parameter):
    """(x1, angle1, x2, angle2) [m, rad] -> (4, 2)."""
    x1, a1, x2, a2 = parameter
    return ((x1, -a1), (x1, a1), (x2, -a2), (x2, a2))


def misfit(geometry, parameter, goal):
    """RMS of ln(published / film) about its mean, its mean, and the correlation; infinite where discs overlap
    or lack a film."""
    try:
        film = FilmConduction(geometry, excitation=pairs(parameter), sensor=None)
        n = len(geometry.electrode_pos)
        centre = np.concatenate([geometry.electrode_pos, film.excitation_pos])
        distance = np.linalg.norm(centre[n:, None] - centre[None], axis=2)
        distance[np.arange(4), n + np.arange(4)] = np.inf
        if distance.min() < CLEARANCE:
            return np.inf, np.nan, np.nan
        log_z = np.log(film.impedance(geometry.vert))
    except ValueError:
        return np.inf, np.nan, np.nan
    return (goal - log_z).std(), (goal - log_z).mean(), np.corrcoef(goal, log_z)[0, 1]


def fit(geometry, starts=6):
    """Coarse grid, then a simplex from the best few. Returns [(misfit, parameter)] sorted."""
    goal = target()
    x = np.arange(-17e-3, 4e-3, 2.5e-3)
    angle = np.radians([15, 35, 60, 90, 120])
    place = list(itertools.product(x, angle))
    grid = [(misfit(geometry, (*a, *b), goal)[0], (*a, *b)) for a, b in itertools.combinations(place, 2)]
    grid.sort()
    found = []
    scale = np.array([1e-3, 0.2, 1e-3, 0.2])
    for _, start in grid[:starts]:
        start = np.array(start)
        result = minimize(
            lambda q: min(misfit(geometry, q * scale, goal)[0], 10.0),
            start / scale,
            method="Nelder-Mead",
            options={"maxfev": 150, "xatol": 0.02, "fatol": 1e-5},
        )
        found.append((result.fun, tuple(result.x * scale)))
    return sorted(found)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--skin", default="default", help="name or path of a stored skin")
    parser.add_argument("--starts", type=int, default=6, help="how many grid points to refine")
    arguments = parser.parse_args()
    from biotac_mj.geometry import load_skin

    geometry = load_skin(arguments.skin)
    goal = target()
    print("misfit  corr   x1 [mm]  angle1 [deg]  x2 [mm]  angle2 [deg]  conductivity [S/m]")
    for _, parameter in fit(geometry, arguments.starts):
        rms, offset, correlation = misfit(geometry, parameter, goal)
        x1, a1, x2, a2 = parameter
        sigma = CONDUCTIVITY * np.exp(-offset)
        print(
            f"{rms:.4f}  {correlation:.3f}  {x1 * 1e3:7.2f}  {np.degrees(a1):12.1f}  {x2 * 1e3:7.2f}  "
            f"{np.degrees(a2):12.1f}  {sigma:10.4f}"
        )


if __name__ == "__main__":
    main()
