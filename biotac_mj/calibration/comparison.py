"""The paper's comparison: four configurations over many indentations of eight indenters, against a
reference."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from ..geometry.indenters import INDENTERS
from ..skin.rubber.material import Material
from .configurations import Configuration
from .fit import Calibration
from .forward import simulate
from .indentation import Indentation, plan_indentation
from .reference import stand_in

# Narang et al., ICRA 2021: force errors are means of the norm over time [N], nodal errors of the displacement
# norms [m].
PAPER = {
    "calibration_force": 0.125,
    "force_lowest_indenter": 0.0876,
    "force_highest_indenter": 0.259,
    "force_mean": 0.153,
    "nodal_peak": 1.41e-4,
    "nodal_mean": 1.81e-5,
}
_ANGLES = 50.0  # [deg] range of the random locations about the pad's midline
_ALONG = (-0.0155, -0.0045)  # [m] range of the locations along the finger
_DEPTH, _SAMPLES = (0.6e-3, 1.6e-3), 10  # [m], rows of an indentation


@dataclasses.dataclass
class Comparison:
    """One configuration against the reference.

    Attributes:
      configuration: name. calibration: of its material, or None if that was given.
      force: indenter -> mean over its indentations of the mean norm of the force error over time [N].
      relative: indenter -> the same, relative to the indentation's largest reference force.
      nodal_peak, nodal_mean: mean over indentations and time of the errors of the largest and of the mean
        norm of the outer surface's nodal displacements [m]; nan without a reference.
      rows: one dict for each indentation.
    """

    configuration: str
    calibration: Calibration | None
    material: object
    force: dict
    relative: dict
    nodal_peak: float
    nodal_mean: float
    nonconverged: int
    steps: int
    rows: list

    @property
    def force_mean(self) -> float:
        """Mean over the indenters [N]."""
        return float(np.mean(list(self.force.values())))


def plan_indentations(
    count: int, indenters: list | tuple | None = INDENTERS, seed: int = 0, skin: str = "coarse"
) -> list:
    """`count` random indentations for each indenter: location on the pad, depth, direction up to 25 degrees
    off the normal, and a slide.

    Raises:
      ValueError: unknown indenter, or no room.
    """
    rng = np.random.default_rng(seed)
    plans = []
    for name in indenters:
        for number in range(count):
            place = rng.uniform(*_ALONG), math.radians(rng.uniform(-_ANGLES, _ANGLES))
            depth, slide = rng.uniform(*_DEPTH), rng.choice([0.0, 0.8e-3])
            turn = rng.uniform(0, 2 * math.pi)
            plan = plan_indentation(
                name,
                place,
                depth,
                slide,
                (math.cos(turn), 0.3 * math.sin(turn), math.sin(turn)),
                samples=_SAMPLES,
                skin=skin,
            )
            plans.append(dataclasses.replace(plan, name=f"{name} {number}"))
    return plans


def references(
    plans: Sequence[Indentation], progress: Callable | None = None, **options: object
) -> list[Indentation]:
    """Reference solutions; see `stand_in`."""
    answers = []
    for plan in plans:
        answers.append(stand_in(plan, **options))
        if progress:
            progress()
    return answers


def evaluate(
    configuration: Configuration,
    material: Material,
    indentations: list,
    calibration: object = None,
    device: str = "cpu",
    progress: Callable | None = None,
) -> Comparison:
    """Simulates every indentation with one configuration and material.

    Raises:
      ValueError: no indentations.
    """
    if not indentations:
        raise ValueError("there is no indentation to compare with: plan or read some")
    options = dataclasses.replace(
        configuration.options, max_newton=max(100, configuration.options.max_newton)
    )
    rows = []
    for case in indentations:
        answer = simulate(
            configuration.geometry, options, [material], case, device, modulus=configuration.modulus
        )
        error = np.linalg.norm(answer.force[0] - case.force, axis=1).mean()
        known = case.peak_norm is not None
        rows.append(
            {
                "name": case.name,
                "indenter": case.indenter,
                "force": float(error),
                "peak_force": float(np.linalg.norm(case.force, axis=1).max()),
                "nodal_peak": float(np.abs(answer.peak_norm[0] - case.peak_norm).mean())
                if known
                else math.nan,
                "nodal_mean": float(np.abs(answer.mean_norm[0] - case.mean_norm).mean())
                if known
                else math.nan,
                "nonconverged": int(answer.nonconverged[0]),
                "steps": answer.steps,
            }
        )
        if progress:
            progress()

    def by_indenter(value):
        names = dict.fromkeys(row["indenter"] for row in rows)
        return {
            name: float(np.mean([value(row) for row in rows if row["indenter"] == name])) for name in names
        }

    return Comparison(
        configuration=configuration.name,
        calibration=calibration,
        material=material,
        force=by_indenter(lambda row: row["force"]),
        relative=by_indenter(lambda row: row["force"] / max(row["peak_force"], 1e-12)),
        nodal_peak=float(np.mean([row["nodal_peak"] for row in rows])),
        nodal_mean=float(np.mean([row["nodal_mean"] for row in rows])),
        nonconverged=sum(row["nonconverged"] for row in rows),
        steps=sum(row["steps"] for row in rows),
        rows=rows,
    )


def comparison_table(comparisons: list, reference: str) -> str:
    """The paper's table, with its published numbers in the last column."""
    names = list(comparisons[0].force)
    lines = [
        f"reference: {reference}",
        f"{'force error [N]':<28}"
        + "".join(f"{c.configuration:>18}" for c in comparisons)
        + f"{'the paper':>18}",
    ]

    def line(name, cells, paper):
        lines.append(f"{name:<28}" + "".join(f"{cell:>18}" for cell in cells) + f"{paper:>18}")

    if all(c.calibration for c in comparisons):
        line(
            "calibration",
            [f"{c.calibration.mean:.4f}" for c in comparisons],
            f"{PAPER['calibration_force']:.3f}",
        )
    for name in names:
        line(name, [f"{c.force[name]:.4f} ({c.relative[name]:.0%})" for c in comparisons], "")
    line(
        "lowest indenter",
        [f"{min(c.force.values()):.4f}" for c in comparisons],
        f"{PAPER['force_lowest_indenter']:.4f}",
    )
    line(
        "highest indenter",
        [f"{max(c.force.values()):.4f}" for c in comparisons],
        f"{PAPER['force_highest_indenter']:.3f}",
    )
    line("mean of indenters", [f"{c.force_mean:.4f}" for c in comparisons], f"{PAPER['force_mean']:.3f}")
    line(
        "nodal, maximum norm [m]", [f"{c.nodal_peak:.2e}" for c in comparisons], f"{PAPER['nodal_peak']:.2e}"
    )
    line("nodal, mean norm [m]", [f"{c.nodal_mean:.2e}" for c in comparisons], f"{PAPER['nodal_mean']:.2e}")
    line("steps not converged", [f"{c.nonconverged}/{c.steps}" for c in comparisons], "")
    lines.append(
        "(in brackets: of each indentation's largest reference force; "
        "the paper compared with ANSYS over other indentations)"
    )
    return "\n".join(lines)
