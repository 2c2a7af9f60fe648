"""`calibration.calibrate` by gradients: one press gives the forces and their derivatives by all parameters;
finite differences need a press for each."""

import numpy as np
import torch

from ..cache import cached
from ..calibration import Configuration, FitParameter, Indentation
from ..calibration.forward import CODE, Steps, inputs_of, steps_of
from ..skin import Material
from .press import PARAMETERS, numbers_of
from .record import follow
from .skin import NUMBERS, Skin
from .sweep import Inputs, push_forward

_PRECISION = 1e-4  # of derivatives, which only set the direction


class Forces:
    """Argument `forces` of `calibration.calibrate` for gradients, on the CPU: by E, nu, mu, fill_volume,
    bulk_modulus, contact_stiffness. Keeps the skin between calls, and caches results on disk.

    Raises:
      ValueError: a parameter without gradient.
    """

    def __init__(self):
        self._skins = {}

    def __call__(
        self,
        configuration: Configuration,
        material: Material,
        parameters: list[FitParameter],
        values: np.ndarray,
        indentation: Indentation,
        device: str = "cpu",
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Forces (n, 3) [N], their derivatives by the scaled parameters (n, 3, p), number of steps without
        convergence."""
        steps, skin = self.prepare(configuration, material, parameters, indentation)

        def make():
            found = _forces_and_jacobian(skin, steps, material, parameters, values)
            return dict(zip(("force", "jacobian", "lost"), found))

        body = configuration.geometry, configuration.options, configuration.modulus, indentation
        inputs = [*inputs_of(*body), material, parameters, np.asarray(values, float)]
        found = cached("slopes", inputs, make, (*CODE, "differentiable"))
        return found["force"], found["jacobian"], int(found["lost"])

    def prepare(
        self,
        configuration: Configuration,
        material: Material,
        parameters: list[FitParameter],
        indentation: Indentation,
    ) -> tuple[Steps, Skin]:
        """The path in steps, and its skin."""
        missing = sorted({p.name for p in parameters} - {"friction", *PARAMETERS})
        if missing:
            raise ValueError(
                f"gradients by {', '.join(missing)} are not there: fit with calibration.calibrate, or choose "
                f"from friction, {', '.join(PARAMETERS)}"
            )
        steps, geoms = steps_of(indentation)
        key = configuration.name, configuration.options, material, indentation.indenter
        if key not in self._skins:
            self._skins[key] = Skin(
                configuration.geometry,
                material,
                configuration.options,
                **geoms,
                modulus=configuration.modulus,
                precision=_PRECISION,
            )
        return steps, self._skins[key]


def _forces_and_jacobian(skin, steps, material, parameters, values):
    names = [p.name for p in parameters]
    values = torch.tensor(values, dtype=torch.float64)
    others = [name for name in names if name != "friction"]

    def numbers(values):
        given = numbers_of(skin, {name: values[names.index(name)] for name in others})
        return torch.stack([given[name] for name in NUMBERS])

    slopes = torch.autograd.functional.jacobian(numbers, values).numpy()
    slopes = slopes * [p.slope(float(v)) for p, v in zip(parameters, values)]
    friction = material.friction if "friction" not in names else float(values[names.index("friction")])
    made = dict(zip(NUMBERS, numbers(values)))
    path = steps.pos[None], steps.mat[None]
    trajectory = follow(skin, *path, np.array([friction]), made, dt=steps.dt)
    by_friction = [[p.slope(friction) if p.name == "friction" else 0.0] for p in parameters]
    tangents = Inputs(
        np.zeros((len(parameters), 1, len(steps.pos), 1, 6)),
        np.array(by_friction)[:, None],
        dict(zip(NUMBERS, slopes[..., None])),
    )
    found = push_forward(skin, trajectory, tangents)
    change = found.wrench[:, 0, steps.ends, 0, :3]
    force = np.array([trajectory.steps[i].wrench[0, 0, :3].numpy() for i in steps.ends])
    return force, np.moveaxis(change, 0, -1), sum(r.changes[0].lost for r in trajectory.steps)


def forces_of(
    configuration: Configuration,
    material: Material,
    parameters: list[FitParameter],
    indentation: Indentation,
    device: str = "cpu",
) -> tuple[Forces | None, str]:
    """Argument `forces` of `calibration.calibrate`, and the name of its method for derivatives: gradients,
    or, if they are not available, None and finite differences with the reason."""
    if device != "cpu":
        return None, f"differences (gradients on {device} are not there)"
    forces = Forces()
    try:
        forces.prepare(configuration, material, parameters, indentation)
    except ValueError as error:
        return None, f"differences ({str(error).partition(':')[0]})"
    return forces, "gradients"
