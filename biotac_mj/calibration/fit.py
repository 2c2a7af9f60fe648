"""Fits material and solver parameters to the forces of one indentation, as Narang et al. (ICRA 2021) did.

The cost is the root mean square over time of the norm of the force error. A trust-region Gauss-Newton method
(scipy's least_squares) minimises its square, which has the same minimum and is smooth there. The model's
value and all finite-difference columns of its Jacobian
are the worlds of one batch; each solver option, which a batch shares, needs a separate batch."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..geometry.skin_geometry import SkinGeometry
from ..skin.model import SkinOptions, stiffness_of_contact
from ..skin.rubber.material import Material
from .configurations import Configuration
from .forward import simulate
from .indentation import Indentation
from .statistics import covariance, ljung_box

_STEP = 0.01  # finite difference of a scaled parameter: 1 % of a positive one, far above the solver's error
# Solver tolerance at which forces repeat to 1e-5 N. A step without convergence makes the cost jump, so the
# iteration limit is high.
TOLERANCE, MAX_NEWTON = 1e-6, 200
_CONFIDENCE = 0.95
_GAIN = 1e-3  # least predicted reduction of the cost for another fit


@dataclasses.dataclass(frozen=True)
class FitParameter:
    """A number to fit.

    Attributes:
      name: a number of Material or of SkinOptions.
      lower, upper: bounds.
      logarithmic: the fit is in the logarithm (positive bounds), else in the number over the width of its
        bounds.
    """

    name: str
    lower: float
    upper: float
    logarithmic: bool = False

    def scaled(self, value: float) -> float:
        """Scaled, dimensionless search variable for a value."""
        return np.log(value) if self.logarithmic else 2 * value / (self.upper - self.lower)

    def value(self, scaled: float) -> float:
        """The value, in its unit, for a scaled variable."""
        return float(np.exp(scaled)) if self.logarithmic else float(scaled * (self.upper - self.lower) / 2)

    def slope(self, value: float) -> float:
        """d value / d scaled."""
        return value if self.logarithmic else (self.upper - self.lower) / 2


PARAMETERS = {
    "youngs_modulus": FitParameter("youngs_modulus", 1e4, 1e8, True),
    "poissons_ratio": FitParameter("poissons_ratio", 0.0, 0.49),
    "friction": FitParameter("friction", 0.01, 3.0, True),
    "contact_stiffness": FitParameter("contact_stiffness", 1e9, 1e14, True),
    "stick_ratio": FitParameter("stick_ratio", 1e-3, 1.0, True),
    "bulk_modulus": FitParameter("bulk_modulus", 1e3, 1e10, True),
}
_SHORT = {"E": "youngs_modulus", "nu": "poissons_ratio", "mu": "friction"}
_MATERIAL = [f.name for f in dataclasses.fields(Material) if f.type in (float, "float")]
_OPTIONS = [  # physical ones: a tolerance of the solver is no parameter of the skin
    f.name
    for f in dataclasses.fields(SkinOptions)
    if f.type in (float, "float", float | None, "float | None") and f.name != "tolerance"
]


def parameter(text: str) -> FitParameter:
    """A FitParameter from "NAME" or "NAME:LOWER:UPPER"; E, nu and mu are short for Young's modulus, Poisson's
    ratio and friction.

    Raises:
      ValueError: unknown name, invalid bounds, or no bounds for a name without default ones.
    """
    name, *bounds = text.split(":")
    name = _SHORT.get(name, name)
    if name not in (*_MATERIAL, *_OPTIONS):
        known = ", ".join(dict.fromkeys((*_MATERIAL, *_OPTIONS)))
        raise ValueError(f"cannot fit {name!r}: choose E, nu, mu or one of {known}")
    if not bounds:
        if name not in PARAMETERS:
            raise ValueError(f"no bounds are known for {name}: give them as {name}:LOWER:UPPER")
        return PARAMETERS[name]
    try:
        lower, upper = (float(b) for b in bounds)
    except ValueError:
        raise ValueError(f"bounds of {text!r} are not two numbers: write {name}:LOWER:UPPER") from None
    if not (np.isfinite([lower, upper]).all() and lower < upper):
        raise ValueError(
            f"bounds of {text!r} are no interval: write {name}:LOWER:UPPER with LOWER < UPPER, both finite"
        )
    owner = (
        Material() if name in _MATERIAL else SkinOptions(dynamics="implicit")
    )  # whose damping may be fitted
    for bound in (lower, upper):
        try:
            dataclasses.replace(owner, **{name: bound})
        except ValueError as error:
            raise ValueError(f"bounds of {text!r}: {error}") from None
    return FitParameter(name, lower, upper, lower > 0 and upper > 10 * lower)


@dataclasses.dataclass
class Calibration:
    """Result of a fit with n samples and p parameters.

    Attributes:
      configuration, skin, law, element, liquid, indenter: settings of the fit.
      parameters: names.
      start, value: (p,) before and after.
      interval: (p, 2) 95 % confidence, from the larger of the two standard errors.
      standard_error: (p,) for white residuals; standard_error_robust: (p,) after Newey and West, with `lags`.
      correlation: (p, p) of the parameters.
      at_bound: (p,) whether a parameter is on a bound, where its interval is unreliable.
      rms, mean: of the norm of the force error over time [N]; peak: largest measured force [N].
      whiteness: Ljung-Box test of the residual's components.
      material, options: of the result, including those that were not fitted.
      measured, fitted: (n, 3) [N]; time: (n,) [s].
      evaluations: batches; success, message: of the last optimiser.
      nonconverged: steps of the skin at the result that did not converge.
    """

    configuration: str
    skin: str
    law: str
    element: str
    liquid: bool
    indenter: str
    parameters: list
    start: np.ndarray
    value: np.ndarray
    interval: np.ndarray
    standard_error: np.ndarray
    standard_error_robust: np.ndarray
    lags: int
    correlation: np.ndarray
    at_bound: np.ndarray
    rms: float
    mean: float
    peak: float
    whiteness: dict
    material: Material
    options: SkinOptions
    time: np.ndarray
    measured: np.ndarray
    fitted: np.ndarray
    evaluations: int
    success: bool
    message: str
    nonconverged: int


def forces_and_jacobian(
    configuration: Configuration,
    material: Material,
    parameters: list,
    values: np.ndarray,
    indentation: Indentation,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray]:
    """The model's forces and their derivatives with respect to the scaled parameters, with columns as worlds
    of one batch.

    Returns:
      force (n, 3) [N], jacobian (n, 3, p) [N], nonconverged steps of the first world.
    """
    values = np.asarray(values, float)
    scaled = np.array([p.scaled(v) for p, v in zip(parameters, values)])
    upper = np.array([p.scaled(p.upper) for p in parameters])
    steps = np.where(scaled + _STEP > upper, -_STEP, _STEP)
    points = [values]
    for i, p in enumerate(parameters):
        point = values.copy()
        point[i] = p.value(scaled[i] + steps[i])
        points.append(point)
    force, lost = [None] * len(points), 0
    cases = [_case(configuration.options, material, parameters, point) for point in points]
    for options in dict.fromkeys(options for options, _ in cases):
        members = [i for i, case in enumerate(cases) if case[0] == options]
        response = simulate(
            configuration.geometry,
            options,
            [cases[i][1] for i in members],
            indentation,
            device,
            modulus=configuration.modulus,
        )
        for i, f in zip(members, response.force):
            force[i] = f
        if 0 in members:
            lost = int(response.nonconverged[members.index(0)])
    jacobian = np.stack([(f - force[0]) / h for f, h in zip(force[1:], steps)], -1)
    return force[0], jacobian, lost


def _case(options, material, parameters, point):
    """Options and material with the parameters' values."""
    changes = {p.name: float(v) for p, v in zip(parameters, point)}
    on_material = {name: v for name, v in changes.items() if name in _MATERIAL}
    on_options = {name: v for name, v in changes.items() if name not in _MATERIAL}
    return dataclasses.replace(options, **on_options), dataclasses.replace(material, **on_material)


def calibrate(
    configuration: Configuration,
    material: Material,
    indentation: Indentation,
    parameters: Sequence[str | FitParameter] = ("E", "nu", "mu"),
    *,
    max_iterations: int = 20,
    device: str = "cpu",
    progress: bool = False,
    finer: SkinGeometry | None = None,
    corrections: int = 2,
    forces: Callable | None = None,
    starts: int = 1,
) -> Calibration:
    """Fits parameters to the force of an indentation.

    The contact stiffness remains that of the starting material, unless it is fitted: 180 E per millimetre is
    so stiff that twice as much hardly changes the force, and a batch has a single value.

    Args:
      configuration: body and options; liquid is `options.liquid`, or the material's if that is None.
      material: law and starting values.
      parameters: names, as in `parameter`, or FitParameters.
      progress: whether to show a bar.
      finer: a finer mesh of the same body, or None. The fit on the configuration's mesh is then corrected by
        the difference of both meshes' forces at the fitted values and repeated, `corrections` times (space
        mapping). The result fits the data on the finer mesh, at the cost of `corrections` indentations of it.
      forces: function that returns forces and their Jacobian, like `forces_and_jacobian`.
      starts: number of starting points for the final fit: further ones are drawn from the error of the best
        fit and skipped if the slopes predict no improvement. If a step of the press has two equilibria, the
        forces jump as a function of the parameters, and a fit stays on its side of the jump; several starts
        cover both sides.

    Raises:
      ValueError: an unknown parameter, a start outside its bounds, data without force, or parameters that the
        forces do not identify.
    """
    parameters = [p if isinstance(p, FitParameter) else parameter(p) for p in parameters]
    if not parameters or len({p.name for p in parameters}) != len(parameters):
        raise ValueError("name each parameter to fit once, and at least one")
    fixed = _converged_further(configuration, material)
    begin = _begin(parameters, material, fixed.options)
    problem = _Problem(
        fixed, material, indentation, parameters, forces or forces_and_jacobian, device, progress
    )
    start = np.array([p.scaled(v) for p, v in zip(parameters, begin)])
    problem.check(start)
    # with exact derivatives a step after one with a gain below 1e-4 gains nothing
    tolerance = (1e-4, 1e-4) if finer is not None or forces is not None else (1e-5, 1e-6)

    def finish(at, correction=0.0):
        return problem.least_squares(at, correction, tolerance, max_iterations)

    found, correction = finish(start), 0.0
    draw = np.random.default_rng(0)
    for _ in range(starts - 1):
        at = problem.draw_start(found.x, draw)
        if problem.promised(at) < (1 - _GAIN) * found.cost:
            found = min(found, finish(at), key=lambda fit: fit.cost)
    modulus = configuration.modulus
    if finer is not None and modulus is not None and not callable(modulus):  # repeat per child, see `refined`
        modulus = np.repeat(modulus, len(finer.elem) // len(modulus))
    for _ in range(corrections if finer is not None else 0):
        values, force, _, _ = problem.evaluate(found.x)
        case = _case(fixed.options, material, parameters, values)
        there = simulate(finer, case[0], [case[1]], indentation, device, modulus=modulus)
        correction = there.force[0] - force
        found = finish(found.x, correction)
    values, force, jacobian, lost = problem.evaluate(found.x)
    problem.close()
    result = _result(
        fixed,
        material,
        indentation,
        parameters,
        begin,
        values,
        force + correction,
        jacobian,
        lost,
        problem.simulated,
        found,
    )
    return (
        result
        if finer is None
        else dataclasses.replace(result, skin=f"{result.skin}, corrected by {finer.name}")
    )


def _converged_further(configuration, material):
    """The configuration with the starting material's contact stiffness and a tighter tolerance."""
    options = configuration.options
    return dataclasses.replace(
        configuration,
        options=dataclasses.replace(
            options,
            contact_stiffness=options.contact_stiffness or stiffness_of_contact(material),
            tolerance=min(TOLERANCE, options.tolerance),
            max_newton=max(MAX_NEWTON, options.max_newton),
        ),
    )


def _begin(parameters, material, options):
    """Starting values of parameters, within their bounds."""
    begin = np.array(
        [getattr(material, p.name, None) or getattr(options, p.name, 0.0) for p in parameters], float
    )
    for p, value in zip(parameters, begin):
        if not p.lower <= value <= p.upper:
            raise ValueError(
                f"the fit of {p.name} starts at {value:g}, outside {p.lower:g} to {p.upper:g}: "
                "change the start or the bounds"
            )
    return begin


class _Problem:
    """Least squares of the force of an indentation over scaled parameters (n,); simulated points are cached.

    Attributes:
      lower, upper: (n,) bounds.
    """

    def __init__(self, configuration, material, indentation, parameters, forces, device, progress):
        import tqdm

        self._given = configuration, material, parameters
        self._indentation, self._forces, self._device = indentation, forces, device
        self._scale = np.sqrt((indentation.force**2).sum(1).mean())
        if not self._scale > 0:
            raise ValueError(
                f"indentation {indentation.name!r} has no force: measure it, or simulate it first"
            )
        self.lower = np.array([p.scaled(p.lower) for p in parameters])
        self.upper = np.array([p.scaled(p.upper) for p in parameters])
        self._bar = tqdm.tqdm(desc="calibrate", unit="batch", disable=not progress or None, leave=False)
        self._cache = {}

    @property
    def simulated(self):
        """Number of points."""
        return len(self._cache)

    def close(self):
        self._bar.close()

    def evaluate(self, scaled):
        """Values of the parameters, force, its Jacobian and number of steps without convergence."""
        key = scaled.tobytes()
        if key not in self._cache:
            configuration, material, parameters = self._given
            values = np.clip(
                [p.value(s) for p, s in zip(parameters, scaled)],
                [p.lower for p in parameters],
                [p.upper for p in parameters],
            )
            found = self._forces(configuration, material, parameters, values, self._indentation, self._device)
            self._cache[key] = (values, *found)
            off = self._cache[key][1] - self._indentation.force
            self._bar.update()
            self._bar.set_postfix(rms_N=f"{np.sqrt((off**2).sum(1).mean()):.4f}")
        return self._cache[key]

    def check(self, start):
        """Raises ValueError if the force does not depend on a parameter."""
        for p, column in zip(self._given[2], np.moveaxis(self.evaluate(start)[2], -1, 0)):
            if np.sqrt((column**2).sum(1).mean()) < 1e-6 * self._scale:
                raise ValueError(
                    f"the force of this indentation does not depend on {p.name}: "
                    "leave it out, or load the skin so that it matters"
                )

    def within(self, at):
        """The nearest point within the bounds."""
        return np.clip(at, self.lower + 1e-9, self.upper - 1e-9)

    def _residual(self, s, correction=0.0):
        return ((self.evaluate(s)[1] + correction - self._indentation.force) / self._scale).ravel()

    def _slopes(self, s):
        return self.evaluate(s)[2].reshape(-1, len(s)) / self._scale

    def least_squares(self, at, correction, tolerance, max_iterations):
        """Gauss-Newton fit from a point: changes of contact make kinks in the cost that would mislead an
        estimate of its curvature. tolerance: of cost and of step."""
        from scipy.optimize import least_squares

        return least_squares(
            lambda s: self._residual(s, correction),
            self.within(at),
            jac=self._slopes,
            bounds=(self.lower, self.upper),
            x_scale="jac",
            ftol=tolerance[0],
            xtol=tolerance[1],
            max_nfev=max_iterations,
        )

    def draw_start(self, at, rng):
        """A point drawn from the error distribution of a fit."""
        _, force, jacobian, _ = self.evaluate(at)
        spread = np.linalg.cholesky(covariance(jacobian, force - self._indentation.force)[0])
        return self.within(at + spread @ rng.normal(size=len(at)))

    def promised(self, at):
        """Predicted least cost for forces that are linear from there, so on that side of a jump."""
        residual, slopes = self._residual(at), self._slopes(at)
        return ((residual - slopes @ np.linalg.lstsq(slopes, residual)[0]) ** 2).sum() / 2


def _result(
    configuration, material, indentation, parameters, begin, values, force, jacobian, lost, evaluations, found
):
    from scipy.special import stdtrit  # scipy.stats takes a second to import

    residual = force - indentation.force
    by_value = jacobian / np.array([p.slope(v) for p, v in zip(parameters, values)])
    white, robust, lags = covariance(by_value, residual)
    error, error_robust = np.sqrt(np.diag(white)), np.sqrt(np.diag(robust))
    half = stdtrit(len(residual) - len(parameters), (1 + _CONFIDENCE) / 2) * np.maximum(error, error_robust)
    options, fitted = _case(configuration.options, material, parameters, values)
    norm = np.linalg.norm(residual, axis=1)
    width = [1e-6 * (p.upper - p.lower) for p in parameters]
    return Calibration(
        configuration=configuration.name,
        skin=configuration.geometry.name,
        law=material.law,
        element=options.element or material.element or configuration.geometry.element,
        liquid=bool(material.liquid if options.liquid is None else options.liquid),
        indenter=indentation.indenter,
        parameters=[p.name for p in parameters],
        start=begin,
        value=values,
        interval=np.stack([values - half, values + half], 1),
        standard_error=error,
        standard_error_robust=error_robust,
        lags=lags,
        correlation=white / np.outer(error, error) if (error > 0).all() else np.eye(len(values)),
        at_bound=np.array([min(v - p.lower, p.upper - v) < w for v, p, w in zip(values, parameters, width)]),
        rms=float(np.sqrt((norm**2).mean())),
        mean=float(norm.mean()),
        peak=float(np.linalg.norm(indentation.force, axis=1).max()),
        whiteness=ljung_box(residual),
        material=fitted,
        options=options,
        time=np.asarray(indentation.time),
        measured=indentation.force,
        fitted=force,
        evaluations=evaluations,
        success=bool(found.success),
        message=str(found.message),
        nonconverged=lost,
    )
