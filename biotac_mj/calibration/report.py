"""Reports of fits and comparisons: tables, JSON and a picture."""

import dataclasses
import json
import pathlib

from .. import files
from .fit import Calibration

_UNITS = {
    "youngs_modulus": "Pa",
    "contact_stiffness": "Pa/m",
    "bulk_modulus": "Pa",
    "fill_volume": "m^3",
    "rest_pressure": "Pa",
}


def calibration_table(result: Calibration) -> str:
    """The result as text."""
    liquid = "with liquid" if result.liquid else "without liquid"
    lines = [
        f"{result.configuration} on skin {result.skin}, {result.law}, {result.element} elements, "
        f"{liquid}, pressed by {result.indenter}"
    ]
    lines.append(f"{'parameter':<20}{'start':>13}{'fitted':>13}   95 % confidence")
    for i, name in enumerate(result.parameters):
        low, high = result.interval[i]
        note = "  on its bound: the interval means little" if result.at_bound[i] else ""
        lines.append(
            f"{name:<20}{result.start[i]:>13.6g}{result.value[i]:>13.6g}   {low:.6g} .. "
            f"{high:.6g} {_UNITS.get(name, '')}{note}"
        )
    lines.append(
        f"force error: RMS {result.rms:.4f} N, mean {result.mean:.4f} N, "
        f"of {result.peak:.3f} N at most (the paper: mean 0.125 N)"
    )
    values = ", ".join(f"{axis} {p:.3g}" for axis, p in zip("xyz", result.whiteness["p_value"]))
    verdict = "white" if result.whiteness["white"] else "not white: the model leaves something unexplained"
    lines.append(f"residual: Ljung-Box over {result.whiteness['lags']} lags, p = {values}: {verdict}")
    how = "converged" if result.success else f"did NOT converge ({result.message})"
    lines.append(
        f"the fit {how} after {result.evaluations} batches; "
        f"steps of the skin that did not converge: {result.nonconverged}"
    )
    return "\n".join(lines)


def write_json(content: dict, path: pathlib.Path | str) -> None:
    """Writes a dataclass or dict as JSON, to a temporary name, then renamed; numbers that are not finite
    become null."""

    def default(value):
        return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value.tolist()

    text = json.dumps(content, default=default)
    files.write_json(path, json.loads(text, parse_constant=lambda _: None))


def write_picture(result: Calibration, path: pathlib.Path | str) -> None:
    """Measured and fitted force over time, and the residual."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(7, 6), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    for i, color in enumerate(("tab:red", "tab:green", "tab:blue")):
        top.plot(result.time, result.measured[:, i], "o", mfc="none", ms=4, color=color)
        top.plot(result.time, result.fitted[:, i], lw=1.2, color=color, label=f"F{'xyz'[i]}")
        bottom.plot(result.time, result.fitted[:, i] - result.measured[:, i], ".-", lw=0.8, ms=3, color=color)
    fitted = ", ".join(f"{name} {value:.4g}" for name, value in zip(result.parameters, result.value))
    top.set_title(
        f"{result.configuration}, {result.indenter}: {fitted}\nRMS force error {result.rms:.4f} N", fontsize=8
    )
    top.set_ylabel("force on the indenter [N]\n(circles: measured, lines: fitted)")
    top.legend(fontsize=8)
    bottom.axhline(0, lw=0.5, color="black")
    bottom.set_ylabel("fitted - measured [N]")
    bottom.set_xlabel("time [s]")
    files.save_figure(path, figure, 120)
    plt.close(figure)
