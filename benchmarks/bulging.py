"""Where the liquid goes: PDC and the electrodes' impedances while a sphere presses at many places, for
docs/lab/liquid.md.

python benchmarks/bulging.py --skin coarse
"""

import argparse

import numpy as np

from biotac_mj.geometry import load_skin
from biotac_mj.press import approach
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.skin import GeomSet, SkinData, SkinModel, SkinOptions, step

__all__ = ["LOCATIONS", "presses"]

# x [m], angle around the finger [rad]
LOCATIONS = [(x, angle) for x in (-16e-3, -12e-3, -8e-3, -4e-3) for angle in (-0.6, 0.0, 0.6)]
RADIUS = 3.5e-3  # [m]


def presses(model, locations=LOCATIONS, depths=None):
    """Presses at each location in turn.

    Returns:
      pressure (nlocation, ndepth) above rest [Pa]; change (nlocation, ndepth, 19) of ln Z; distance
      (nlocation, 19) of the electrodes from where the sphere touches [m].
    """
    depths = np.linspace(0, 2e-3, 21)[1:] if depths is None else depths
    geometry = model.geometry
    film = FilmConduction(geometry, sensor=None)
    rest = film.impedance(model.rest.vert)
    data = SkinData(model)
    pressure, change, distance = [], [], []
    for location in locations:
        point, normal = approach.surface_point(geometry, *location)
        data.reset()
        geoms = GeomSet(["sphere"], [(RADIUS,)], [model.material.friction])
        rows = []
        for depth in depths:
            geoms.set_pose([point + (RADIUS - depth) * normal])
            step(model, data, geoms)
            if not data.converged.all():
                raise RuntimeError(f"the press at {location} did not converge at {1e3 * depth:.2f} mm")
            rows.append((data.pressure[0], np.log(film.impedance(data.vert_xpos[0]) / rest)))
        pressure.append([p for p, _ in rows])
        change.append([c for _, c in rows])
        distance.append(np.linalg.norm(geometry.electrode_pos - point, axis=1))
    return np.array(pressure), np.array(change), np.array(distance)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--skin", default="default")
    parser.add_argument("--material", default="default")
    parser.add_argument("--rest-pressure", type=float, default=0.0)
    parser.add_argument("--no-liquid", action="store_true")
    args = parser.parse_args()
    options = SkinOptions(liquid=not args.no_liquid, rest_pressure=args.rest_pressure)
    pressure, change, distance = presses(SkinModel(load_skin(args.skin), args.material, options))
    print(
        f"{args.skin} skin, {args.material}, rest pressure {args.rest_pressure:g} Pa, "
        f"{'no ' if args.no_liquid else ''}liquid"
    )
    print("   x mm  angle  PDC max kPa  monotone to mm  lower Z, all  far half")
    far = distance > np.median(distance, axis=1)[:, None]
    for i, (x, angle) in enumerate(LOCATIONS):
        rising = np.append(np.diff(pressure[i]) > 0, False)
        until = np.linspace(0, 2, 21)[1:][rising.argmin()]
        lower = change[i] < 0
        shares = f"{lower.mean():13.0%} {lower[:, far[i]].mean():9.0%}"
        print(f"{1e3 * x:7.0f} {angle:6.1f} {pressure[i].max() / 1e3:12.2f} {until:15.1f} {shares}")
    lower = change < 0
    everywhere = np.broadcast_to(far[:, None], change.shape)
    print(
        f"all: Z lower in {lower.mean():.1%} of the samples, in the far half {lower[everywhere].mean():.1%}"
    )
    # three counts of noise at 3000: dE / E = -(1 - E / 4095) d ln Z
    pull = np.abs(change) > 3 / 3000 / (1 - 3000 / 4095)
    print(f"beyond the noise: lower {(lower & pull).mean():.1%}, higher {(~lower & pull).mean():.1%}")


if __name__ == "__main__":
    main()
